//! Which CAN interface an adapter is, by its serial number or its USB port, from sysfs.
//!
//! The kernel numbers interfaces (`can0`, `can1`) in the order in which it finds adapters, which
//! changes from boot to boot and whenever one is plugged in again. A serial number stays with the
//! adapter, a port with the socket that it is plugged into. The files read are:
//!
//! | file below `/sys/class/net/<interface>` | meaning |
//! |---|---|
//! | `type` | 280 for CAN |
//! | `device` | a link into the folder of the USB interface, if it is one |
//! | above that folder: the first with `idVendor` | the USB device; its name is the port |
//! | its `serial`, `product` | as the adapter tells them; not all have a serial number |
//! | `dev_port`, `dev_id` | the channel of an adapter with several; drivers set one of the two |

use serde::Deserialize;
use std::fmt;
use std::fs;
use std::path::Path;

/// Where the kernel's sysfs is.
pub const SYS: &str = "/sys";

/// The way in which a configuration names a CAN interface.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(try_from = "Keys")]
pub enum Adapter {
    /// By the kernel's name, such as `can0`.
    Interface(String),
    /// By the serial number of its USB device.
    Serial {
        /// The number, as `lsusb -v` and `proprio doctor` show it.
        serial: String,
        /// The channel of an adapter with several interfaces.
        channel: Option<u32>,
    },
    /// By the USB port into which it is plugged.
    UsbPort {
        /// The port, such as `1-2.3`: bus 1, port 2, port 3 of the hub there.
        port: String,
        /// The channel of an adapter with several interfaces.
        channel: Option<u32>,
    },
}

/// The keys of `source` in gateway.toml.
#[derive(Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
struct Keys {
    /// The kernel's name, such as `can0`. Needed, unless `serial` or `usb_port` is given.
    interface: Option<String>,
    /// The serial number of the adapter, as `proprio doctor` shows it.
    serial: Option<String>,
    /// The USB port that the adapter is plugged into, such as `1-2.3`: `proprio doctor` shows it.
    usb_port: Option<String>,
    /// The channel of an adapter with several interfaces; with `serial` or `usb_port`.
    channel: Option<u32>,
}

impl TryFrom<Keys> for Adapter {
    type Error = String;

    fn try_from(keys: Keys) -> Result<Self, String> {
        let empty = |key: &str| format!("{key} = \"\" must not be empty");
        match (keys.interface, keys.serial, keys.usb_port, keys.channel) {
            // An interface's name is what `struct ifreq` has room for.
            (Some(name), None, None, _) if name.is_empty() || name.len() > 15 => Err(format!(
                "interface = {name:?} must have 1 to 15 characters, such as \"can0\""
            )),
            (Some(_), None, None, Some(_)) => {
                Err("channel belongs to serial or usb_port: an interface is one channel".into())
            }
            (Some(name), None, None, None) => Ok(Self::Interface(name)),
            (None, Some(serial), None, _) if serial.is_empty() => Err(empty("serial")),
            (None, Some(serial), None, channel) => Ok(Self::Serial { serial, channel }),
            (None, None, Some(port), _) if port.is_empty() => Err(empty("usb_port")),
            (None, None, Some(port), channel) => Ok(Self::UsbPort { port, channel }),
            _ => Err("kind = \"socketcan\" needs one of interface = \"can0\", \
                 serial = \"...\" and usb_port = \"1-2.3\" (`proprio doctor` lists them)"
                .into()),
        }
    }
}

impl fmt::Display for Adapter {
    /// As the keys of a configuration: `serial = "0042", channel = 1`; an interface's name alone.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (key, value, channel) = match self {
            Self::Interface(name) => return f.write_str(name),
            Self::Serial { serial, channel } => ("serial", serial, channel),
            Self::UsbPort { port, channel } => ("usb_port", port, channel),
        };
        write!(f, "{key} = {value:?}")?;
        channel.map_or(Ok(()), |channel| write!(f, ", channel = {channel}"))
    }
}

/// Why an adapter is no interface of this machine.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NotFound {
    /// No adapter of this name.
    #[error("there is no CAN adapter with {adapter}; there {}", are(.present))]
    Absent {
        /// The keys.
        adapter: Adapter,
        /// All adapters that there are, in words.
        present: Vec<String>,
    },
    /// Several adapters with this serial number, as copies of a design have it.
    #[error(
        "several CAN adapters have {adapter}: {}; name each by its port instead, with usb_port",
        found.join("; ")
    )]
    Several {
        /// The keys.
        adapter: Adapter,
        /// The adapters, in words.
        found: Vec<String>,
    },
    /// One adapter with several interfaces.
    #[error("the CAN adapter with {adapter} has several interfaces: {}; add channel = ...",
        found.join("; "))]
    Channels {
        /// The keys.
        adapter: Adapter,
        /// Its interfaces, in words.
        found: Vec<String>,
    },
}

/// What there is, for a message.
fn are(present: &[String]) -> String {
    match present {
        [] => "is none".to_owned(),
        all => format!("are {}", all.join("; ")),
    }
}

/// A CAN interface of this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Present {
    /// Its name.
    pub interface: String,
    /// Its adapter, if it is on USB.
    pub usb: Option<Usb>,
    /// Its channel of the adapter.
    pub channel: u32,
}

/// What a USB adapter tells of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Usb {
    /// The port that it is plugged into.
    pub port: String,
    /// Its serial number, if it has one.
    pub serial: Option<String>,
    /// The name of the product; empty if it has none.
    pub product: String,
}

impl fmt::Display for Present {
    /// `can0 (serial = "0042", usb_port = "1-2.3", channel = 0, USB2CAN)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.interface)?;
        let Some(usb) = &self.usb else {
            return Ok(());
        };
        f.write_str(" (")?;
        if let Some(serial) = &usb.serial {
            write!(f, "serial = {serial:?}, ")?;
        }
        write!(f, "usb_port = {:?}, channel = {}", usb.port, self.channel)?;
        if !usb.product.is_empty() {
            write!(f, ", {}", usb.product)?;
        }
        f.write_str(")")
    }
}

/// A file's text without line end; `None` if it cannot be read or is empty.
fn text(file: &Path) -> Option<String> {
    let text = fs::read_to_string(file).ok()?;
    let text = text.trim();
    (!text.is_empty()).then(|| text.to_owned())
}

/// A number as sysfs writes it: decimal, or hexadecimal after `0x`.
fn number(file: &Path) -> u32 {
    let text = text(file).unwrap_or_default();
    let number = match text.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16),
        None => text.parse(),
    };
    number.unwrap_or(0)
}

/// The USB device above `device`, a link from an interface.
fn usb(device: &Path) -> Option<Usb> {
    let folder = fs::canonicalize(device).ok()?;
    let device = folder.ancestors().find(|f| f.join("idVendor").is_file())?;
    Some(Usb {
        port: device.file_name()?.to_string_lossy().into_owned(),
        serial: text(&device.join("serial")),
        product: text(&device.join("product")).unwrap_or_default(),
    })
}

/// The CAN interfaces of this machine, sorted by name, from the sysfs at `sys` ([`SYS`]).
#[must_use]
pub fn present(sys: &Path) -> Vec<Present> {
    /// Of linux/if_arp.h.
    const ARPHRD_CAN: &str = "280";
    let entries = fs::read_dir(sys.join("class/net"));
    let mut present: Vec<Present> = (entries.into_iter().flatten().flatten())
        .filter(|entry| text(&entry.path().join("type")).as_deref() == Some(ARPHRD_CAN))
        .map(|entry| {
            let path = |file: &str| entry.path().join(file);
            Present {
                interface: entry.file_name().to_string_lossy().into_owned(),
                usb: usb(&path("device")),
                // The one that a driver does not set is 0.
                channel: number(&path("dev_port")).max(number(&path("dev_id"))),
            }
        })
        .collect();
    // can2 before can10.
    present.sort_by_cached_key(|p| {
        let word = p.interface.trim_end_matches(|c: char| c.is_ascii_digit());
        let number = p.interface.strip_prefix(word).and_then(|n| n.parse().ok());
        (word.to_owned(), number.unwrap_or(0_u64))
    });
    present
}

impl Adapter {
    /// The best way to name `interface` for a configuration that lasts, of the interfaces in
    /// `present`: the serial number, unless another adapter has the same; else the USB port; else
    /// the interface's name.
    #[must_use]
    pub fn lasting(interface: &str, present: &[Present]) -> Self {
        let by_name = Self::Interface(interface.to_owned());
        let Some(this) = present.iter().find(|p| p.interface == interface) else {
            return by_name;
        };
        let Some(usb) = &this.usb else {
            return by_name;
        };
        let others = || (present.iter()).filter(|other| other.interface != interface);
        let others = || others().filter_map(|other| other.usb.as_ref());
        let has_more = others().any(|other| other.port == usb.port);
        let channel = has_more.then_some(this.channel);
        let is_copy = |other: &Usb| other.port != usb.port && other.serial == usb.serial;
        match &usb.serial {
            Some(serial) if !others().any(is_copy) => Self::Serial {
                serial: serial.clone(),
                channel,
            },
            _ => Self::UsbPort {
                port: usb.port.clone(),
                channel,
            },
        }
    }

    /// The name of its interface at this moment, from the sysfs at `sys` ([`SYS`]). A name is
    /// returned as it is, whether there is such an interface or not.
    ///
    /// # Errors
    /// [`NotFound`]: no interface, or more than one.
    pub fn resolve(&self, sys: &Path) -> Result<String, NotFound> {
        if let Self::Interface(name) = self {
            return Ok(name.clone());
        }
        let all = present(sys);
        let is_it = |present: &&Present| {
            let Some(usb) = &present.usb else {
                return false;
            };
            let (named, channel) = match self {
                Self::Interface(_) => return false,
                Self::Serial { serial, channel } => (usb.serial.as_ref() == Some(serial), channel),
                Self::UsbPort { port, channel } => (usb.port == *port, channel),
            };
            named && channel.is_none_or(|channel| channel == present.channel)
        };
        let found: Vec<&Present> = all.iter().filter(is_it).collect();
        let words = |list: &[&Present]| list.iter().map(ToString::to_string).collect();
        match found.as_slice() {
            [one] => Ok(one.interface.clone()),
            [] => Err(NotFound::Absent {
                adapter: self.clone(),
                present: all.iter().map(ToString::to_string).collect(),
            }),
            [first, rest @ ..] => {
                let port = |p: &Present| p.usb.as_ref().map(|usb| usb.port.clone());
                let (adapter, found) = (self.clone(), words(&found));
                Err(match rest.iter().all(|other| port(other) == port(first)) {
                    true => NotFound::Channels { adapter, found },
                    false => NotFound::Several { adapter, found },
                })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    /// A tree as the kernel lays it out.
    struct Sys(tempfile::TempDir);

    impl Sys {
        fn new() -> Self {
            let sys = Self(tempfile::tempdir().unwrap());
            fs::create_dir_all(sys.path().join("class/net")).unwrap();
            // Another kind of interface on USB, with the same serial number.
            sys.plug("eth0", "1-9", Some("0042"), 0);
            let eth0 = sys.path().join("class/net/eth0/type");
            fs::write(eth0, "1\n").unwrap();
            // One that is on no USB.
            let vcan = sys.path().join("devices/virtual/net/vcan0");
            fs::create_dir_all(&vcan).unwrap();
            fs::write(vcan.join("type"), "280\n").unwrap();
            symlink(vcan, sys.path().join("class/net/vcan0")).unwrap();
            sys
        }

        fn path(&self) -> &Path {
            self.0.path()
        }

        /// Plugs the adapter of `serial` into `port`; it becomes `name`.
        fn plug(&self, name: &str, port: &str, serial: Option<&str>, channel: u32) {
            let device = self.path().join("devices/pci0/usb1").join(port);
            let part = device.join(format!("{port}:1.0"));
            let net = part.join("net").join(name);
            fs::create_dir_all(&net).unwrap();
            fs::write(device.join("idVendor"), "1d50\n").unwrap();
            fs::write(device.join("product"), "USB2CAN\n").unwrap();
            if let Some(serial) = serial {
                fs::write(device.join("serial"), format!("{serial}\n")).unwrap();
            }
            fs::write(net.join("type"), "280\n").unwrap();
            // Older drivers set the one, newer ones the other.
            fs::write(net.join("dev_id"), format!("{channel:#x}\n")).unwrap();
            fs::write(net.join("dev_port"), "0\n").unwrap();
            symlink(&part, net.join("device")).unwrap();
            symlink(&net, self.path().join("class/net").join(name)).unwrap();
        }

        fn unplug(&self, name: &str) {
            fs::remove_file(self.path().join("class/net").join(name)).unwrap();
        }
    }

    fn keys(text: &str) -> Result<Adapter, String> {
        toml::from_str(text).map_err(|e: toml::de::Error| e.message().to_owned())
    }

    fn resolve(sys: &Sys, text: &str) -> Result<String, String> {
        let adapter = keys(text).unwrap();
        adapter.resolve(sys.path()).map_err(|e| e.to_string())
    }

    #[test]
    fn an_adapter_is_found_under_any_name_of_its_interface() {
        let sys = Sys::new();
        sys.plug("can0", "1-2.3", Some("0042"), 0);
        sys.plug("can1", "1-4", Some("0043"), 0);
        for (text, interface) in [
            ("serial = \"0042\"", "can0"),
            ("serial = \"0043\"", "can1"),
            ("usb_port = \"1-4\"", "can1"),
            ("usb_port = \"1-4\"\nchannel = 0", "can1"),
            ("interface = \"can7\"", "can7"),
        ] {
            assert_eq!(resolve(&sys, text).as_deref(), Ok(interface), "{text}");
        }
        // It is plugged in again, into another port, and the kernel counts on.
        sys.unplug("can0");
        let absent = resolve(&sys, "serial = \"0042\"").unwrap_err();
        assert!(
            absent.contains("no CAN adapter with serial = \"0042\"")
                && absent.contains("can1 (serial = \"0043\", usb_port = \"1-4\"")
                && absent.contains("vcan0"),
            "{absent}"
        );
        sys.plug("can10", "1-5", Some("0042"), 0);
        let found = resolve(&sys, "serial = \"0042\"");
        assert_eq!(found.as_deref(), Ok("can10"));
        let names: Vec<String> = (present(sys.path()).into_iter())
            .map(|present| present.interface)
            .collect();
        assert_eq!(names, ["can1", "can10", "vcan0"]);
        sys.plug("can2", "1-7", None, 0);
        assert_eq!(present(sys.path())[1].interface, "can2");
    }

    #[test]
    fn copies_with_one_serial_number_are_told_apart_by_their_ports() {
        let sys = Sys::new();
        sys.plug("can0", "1-2", Some("123456"), 0);
        sys.plug("can1", "1-3", Some("123456"), 0);
        let several = resolve(&sys, "serial = \"123456\"").unwrap_err();
        for part in ["can0", "\"1-2\"", "can1", "\"1-3\"", "usb_port"] {
            assert!(several.contains(part), "{several}");
        }
        assert_eq!(resolve(&sys, "usb_port = \"1-3\"").as_deref(), Ok("can1"));
        // One without a serial number has a port only.
        sys.plug("can2", "1-6", None, 0);
        assert_eq!(resolve(&sys, "usb_port = \"1-6\"").as_deref(), Ok("can2"));
    }

    #[test]
    fn an_adapter_with_several_channels_needs_one_of_them() {
        let sys = Sys::new();
        sys.plug("can0", "1-2", Some("7"), 0);
        sys.plug("can1", "1-2", Some("7"), 1);
        let channels = resolve(&sys, "serial = \"7\"").unwrap_err();
        assert!(
            channels.contains("several interfaces") && channels.contains("channel = 1"),
            "{channels}"
        );
        let second = resolve(&sys, "serial = \"7\"\nchannel = 1");
        assert_eq!(second.as_deref(), Ok("can1"));
        let third = resolve(&sys, "usb_port = \"1-2\"\nchannel = 2");
        assert!(
            third
                .unwrap_err()
                .contains("usb_port = \"1-2\", channel = 2")
        );
        // A driver that sets the port and not the id.
        fs::write(sys.path().join("class/net/can1/dev_port"), "3\n").unwrap();
        fs::write(sys.path().join("class/net/can1/dev_id"), "0x0\n").unwrap();
        let fourth = resolve(&sys, "serial = \"7\"\nchannel = 3");
        assert_eq!(fourth.as_deref(), Ok("can1"));
    }

    /// The name that is chosen for an interface leads back to it.
    #[test]
    fn a_lasting_name_is_the_serial_number_if_it_is_the_only_one() {
        let sys = Sys::new();
        sys.plug("can0", "1-2", Some("7"), 0);
        sys.plug("can1", "1-2", Some("7"), 1);
        sys.plug("can2", "1-3", Some("8"), 0);
        sys.plug("can3", "1-4", Some("9"), 0);
        sys.plug("can4", "1-5", Some("9"), 0);
        sys.plug("can5", "1-6", None, 0);
        let all = present(sys.path());
        let chosen = all.iter().map(|present| {
            let lasting = Adapter::lasting(&present.interface, &all);
            let back = lasting.resolve(sys.path());
            assert_eq!(back.as_deref(), Ok(present.interface.as_str()));
            lasting.to_string()
        });
        let expected = [
            "serial = \"7\", channel = 0",
            "serial = \"7\", channel = 1",
            "serial = \"8\"",
            "usb_port = \"1-4\"",
            "usb_port = \"1-5\"",
            "usb_port = \"1-6\"",
            "vcan0",
        ];
        assert_eq!(chosen.collect::<Vec<_>>(), expected);
        assert_eq!(Adapter::lasting("can9", &all).to_string(), "can9");
    }

    #[test]
    fn keys_name_an_adapter_in_one_way() {
        for (text, part) in [
            ("", "needs one of interface"),
            (
                "interface = \"can0\"\nserial = \"1\"",
                "needs one of interface",
            ),
            (
                "serial = \"1\"\nusb_port = \"1-2\"",
                "needs one of interface",
            ),
            ("channel = 1", "needs one of interface"),
            ("interface = \"can0\"\nchannel = 1", "belongs to serial"),
            ("interface = \"\"", "1 to 15 characters"),
            ("interface = \"a-very-long-name\"", "1 to 15 characters"),
            ("serial = \"\"", "serial = \"\" must not be empty"),
            ("usb_port = \"\"", "usb_port = \"\" must not be empty"),
            ("seriall = \"1\"", "unknown field `seriall`"),
        ] {
            let problem = keys(text).unwrap_err();
            assert!(problem.contains(part), "{text}: {problem}");
        }
        let shown = keys("serial = \"1\"\nchannel = 2").unwrap().to_string();
        assert_eq!(shown, "serial = \"1\", channel = 2");
    }
}
