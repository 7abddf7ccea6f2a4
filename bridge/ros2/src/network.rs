//! Which part of the network the node is seen in, as a user of ROS 2 says it.

use anyhow::{Context, bail};
use std::net::{IpAddr, Ipv4Addr};

/// The addresses to be seen at; `None`: all of this machine. `interfaces` are names or addresses
/// from the command line; without them, the variables of ROS count, which `variable` reads.
///
/// # Errors
/// An interface has no IPv4 address, or discovery is off.
pub(crate) fn addresses(
    interfaces: &[String],
    variable: impl Fn(&str) -> Option<String>,
) -> anyhow::Result<Option<Vec<IpAddr>>> {
    if !interfaces.is_empty() {
        let all: anyhow::Result<Vec<Vec<IpAddr>>> = interfaces.iter().map(|it| of(it)).collect();
        return Ok(Some(all?.concat()));
    }
    let loopback = Some(vec![IpAddr::V4(Ipv4Addr::LOCALHOST)]);
    if variable("ROS_LOCALHOST_ONLY").is_some_and(|value| value == "1") {
        return Ok(loopback);
    }
    match variable("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref() {
        Some("LOCALHOST") => Ok(loopback),
        Some("OFF") => bail!(
            "ROS_AUTOMATIC_DISCOVERY_RANGE=OFF: nobody would find this node. LOCALHOST shows it to \
             this machine, SUBNET to the network"
        ),
        None | Some("" | "SUBNET" | "SYSTEM_DEFAULT") => Ok(None),
        Some(other) => bail!(
            "ROS_AUTOMATIC_DISCOVERY_RANGE={other}: it is LOCALHOST, SUBNET, OFF or SYSTEM_DEFAULT"
        ),
    }
}

/// The IPv4 addresses of an interface, or the one address that is named.
fn of(interface: &str) -> anyhow::Result<Vec<IpAddr>> {
    let all = nix::ifaddrs::getifaddrs().context("cannot list the network's interfaces")?;
    let all: Vec<(String, Ipv4Addr)> = all
        .filter_map(|one| {
            let address = one.address?.as_sockaddr_in()?.ip();
            Some((one.interface_name, address))
        })
        .collect();
    let found: Vec<IpAddr> = all
        .iter()
        .filter(|(name, address)| name == interface || address.to_string() == interface)
        .map(|(_, address)| IpAddr::V4(*address))
        .collect();
    if found.is_empty() {
        let names: Vec<String> = (all.iter())
            .map(|(name, address)| format!("{name} ({address})"))
            .collect();
        bail!(
            "--interface {interface}: no interface has this name and an IPv4 address; there is {}",
            names.join(", ")
        );
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variables_of_ros_count() {
        let addresses_with = |name: &'static str, value: &'static str| {
            addresses(&[], move |asked| (asked == name).then(|| value.to_owned()))
        };
        let loopback = Some(vec![IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        assert_eq!(addresses_with("", "").unwrap(), None);
        assert_eq!(addresses_with("ROS_LOCALHOST_ONLY", "0").unwrap(), None);
        assert_eq!(addresses_with("ROS_LOCALHOST_ONLY", "1").unwrap(), loopback);
        let range = "ROS_AUTOMATIC_DISCOVERY_RANGE";
        assert_eq!(addresses_with(range, "SUBNET").unwrap(), None);
        assert_eq!(addresses_with(range, "LOCALHOST").unwrap(), loopback);
        assert!(addresses_with(range, "OFF").is_err());
        assert!(addresses_with(range, "EVERYWHERE").is_err());
    }

    #[test]
    fn interfaces_are_named_or_addressed() {
        let addresses_at =
            |interface: &str| addresses(&[interface.to_owned()], |_| Some("1".to_owned()));
        let loopback = Some(vec![IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        assert_eq!(addresses_at("lo").unwrap(), loopback);
        assert_eq!(addresses_at("127.0.0.1").unwrap(), loopback);
        let error = addresses_at("none0").unwrap_err().to_string();
        assert!(error.contains("lo (127.0.0.1)"), "{error}");
    }
}
