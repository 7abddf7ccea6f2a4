//! The control socket: what an operator asks of a running gateway, and the answers.
//!
//! It is `<robot>.gateway.sock` in the folder of the domain, for the user of the gateway alone
//! (mode 0600). A recorder has one likewise, `<robot>.recorder.sock`, for [`RecorderSocket`]'s
//! order. A client sends one JSON object per line and gets one line for each:
//!
//! | line | answer |
//! |---|---|
//! | `{"do": "status"}` | the gateway and its buses |
//! | `{"do": "devices"}` | the devices: state, bus, driver, channels |
//! | `{"do": "tare", "device": "..."}` | `added`: what the board adds from now on \[N, Nm\] |
//! | `{"do": "calibration", "device": "..."}` | the sensor's own, and `problems` of it |
//! | `{"do": "reload"}` | `changed`: the devices that have changed, and which of their keys |
//!
//! `added` is null for a sensor that does not tell. `calibration` asks an F/T board while it
//! streams, or tells what was read at its start: of these what the sensor knows. `full_scale_n`,
//! `full_scale_nm`; `matrix`, by axis (fx fy fz tx ty tz) and gauge, as the sensor stores it;
//! `counts_per_unit` and `unit_n`, `unit_nm`; and `per_count`, the same matrix in N and Nm per
//! count of a gauge. `problems` is empty if nothing is wrong with it (`Defect` in the drivers).
//!
//! `reload` reads the configuration file again. A device whose driver's keys or `listen_only`
//! differ is stopped, replaced and started, as a restart of the gateway would; changed conversions
//! of joints and `max_silence_ms` apply without that. Devices that are equal do not notice. All is
//! taken over or nothing. Nothing, if the file is wrong (`file` and `problem` say why), or if it
//! differs where a restart of the gateway is needed (`restart` names the places).
//!
//! Every answer has `ok`: true, or false with an `error` in words. A device is given by its name,
//! or by `bus/name` if several buses have one of that name.
//!
//! No client can disturb the gateway: it serves at most [`MAX_CLIENTS`] at a time, forgets what of
//! a line is beyond [`MAX_LINE`], and parts with a client that has sent no line, or has not taken
//! an answer, for [`PATIENCE`].
//!
//! The socket is made in a folder that only its user can enter and then moved into place. So nobody
//! else can connect at any moment, and the socket that a killed gateway has left is replaced.

use crate::plan::did_you_mean;
use proprio_topics::ipc::DomainConfig;
use serde::Deserialize;
use serde_json::{Value as Json, json};
use std::fs::{self, DirBuilder, File, Permissions};
use std::io::{self, BufRead as _, BufReader, Read as _, Write as _};
use std::os::fd::AsRawFd as _;
use std::os::unix::fs::{DirBuilderExt as _, PermissionsExt as _};
use std::os::unix::net;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, mpsc as std_mpsc};
use std::thread;
use std::time::Duration;
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

/// Maximum number of clients at a time: several people and scripts.
pub const MAX_CLIENTS: usize = 16;
/// Maximum length of a line in bytes: many times the longest that has a meaning, a tare.
pub const MAX_LINE: usize = 4096;
/// How long the gateway waits for a line, or for a client to take its answer.
pub const PATIENCE: Duration = Duration::from_secs(10);

/// Who can be asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Server {
    /// The gateway of a robot.
    Gateway,
    /// A recorder that holds the last seconds in memory.
    Recorder,
}

impl Server {
    /// In the name of its socket, after the robot's.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Gateway => "gateway",
            Self::Recorder => "recorder",
        }
    }

    /// How long a client waits for an answer: longer than the gateway for its devices, and a
    /// recorder for a slow disk.
    #[must_use]
    pub const fn patience(self) -> Duration {
        match self {
            Self::Gateway => Duration::from_secs(5),
            Self::Recorder => Duration::from_secs(120),
        }
    }
}

/// What is asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ControlOrder {
    Status,
    Devices,
    Tare { device: String },
    Calibration { device: String },
    Reload,
}

/// An order, and where its answer goes.
pub(crate) struct Asked {
    pub(crate) order: ControlOrder,
    pub(crate) answer: oneshot::Sender<Json>,
}

/// The answer to an order that is not carried out.
pub(crate) fn refusal(error: &dyn std::fmt::Display) -> Json {
    json!({ "ok": false, "error": error.to_string() })
}

impl ControlOrder {
    const WORDS: [&str; 5] = ["status", "devices", "tare", "calibration", "reload"];

    /// The order in a line.
    fn parse(line: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct OrderLine {
            r#do: String,
            device: Option<String>,
        }
        let OrderLine { r#do: word, device } = serde_json::from_slice(line)
            .map_err(|e| format!("a line is a JSON object such as {{\"do\": \"status\"}}: {e}"))?;
        let order = match (word.as_str(), device) {
            ("tare", Some(device)) => return Ok(Self::Tare { device }),
            ("calibration", Some(device)) => return Ok(Self::Calibration { device }),
            ("tare" | "calibration", None) => return Err(format!("{word} needs a device")),
            ("status", None) => Self::Status,
            ("devices", None) => Self::Devices,
            ("reload", None) => Self::Reload,
            (word, Some(_)) if Self::WORDS.contains(&word) => {
                return Err(format!("{word} takes no device"));
            }
            (word, _) => {
                return Err(format!(
                    "there is no order {word:?}{}; there is {}",
                    did_you_mean(word, Self::WORDS.into_iter()),
                    Self::WORDS.join(", ")
                ));
            }
        };
        Ok(order)
    }
}

// ---------------------------------------------------------------- the gateway's end

/// The socket of a running gateway; removed when dropped.
pub(crate) struct Socket {
    folder: DomainFolder,
    robot: String,
    server: JoinHandle<()>,
}

impl Socket {
    /// Makes the socket and serves its clients; what they ask goes to `orders`. No other gateway of
    /// this robot may be there.
    pub(crate) fn open(
        domain: &DomainConfig,
        robot: &str,
        orders: mpsc::Sender<Asked>,
    ) -> io::Result<Self> {
        let (folder, listener) = bind(domain, Server::Gateway, robot)?;
        listener.set_nonblocking(true)?;
        let listener = UnixListener::from_std(listener)?;
        Ok(Self {
            folder,
            robot: robot.to_owned(),
            server: tokio::spawn(serve(listener, orders)),
        })
    }
}

impl Drop for Socket {
    fn drop(&mut self) {
        self.server.abort();
        let _ = fs::remove_file(self.folder.socket(Server::Gateway, &self.robot));
    }
}

/// Makes a socket in the folder of the domain.
fn bind(
    domain: &DomainConfig,
    server: Server,
    robot: &str,
) -> io::Result<(DomainFolder, net::UnixListener)> {
    let folder = DomainFolder::open(domain)?;
    let home = folder.path(&format!("{robot}.{}.new", server.word()));
    match fs::remove_dir_all(&home) {
        // A process that was killed while it did the same.
        Ok(()) => {}
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(error),
    }
    DirBuilder::new().mode(0o700).create(&home)?;
    let new = home.join("socket");
    let listener = net::UnixListener::bind(&new)?;
    fs::set_permissions(&new, Permissions::from_mode(0o600))?;
    fs::rename(&new, folder.socket(server, robot))?;
    fs::remove_dir(&home)?;
    Ok((folder, listener))
}

/// How often a recorder looks for clients, and whether its socket is still there.
const TURN: Duration = Duration::from_millis(100);

/// The socket of a recorder: hands on `{"do": "snapshot"}`, one client after the other.
pub struct RecorderSocket {
    asked: std_mpsc::Receiver<Asking>,
    stop: Arc<AtomicBool>,
    thread: Option<thread::JoinHandle<()>>,
}

/// A client that waits for a snapshot.
pub struct Asking(net::UnixStream);

impl Asking {
    /// Tells the client the file that was written, or why none was. One that has left misses it.
    pub fn answer(mut self, file: Result<&Path, &str>) {
        let answer = match file {
            Ok(file) => json!({ "ok": true, "file": file.display().to_string() }),
            Err(error) => refusal(&error),
        };
        let _ = self.0.write_all(format!("{answer}\n").as_bytes());
    }
}

impl RecorderSocket {
    /// Makes the socket and listens, in a thread of its own, which makes it again if it is deleted.
    /// One that another recorder of this robot has made is replaced.
    ///
    /// # Errors
    /// The socket cannot be made.
    pub fn open(domain: &DomainConfig, robot: &str) -> io::Result<Self> {
        let bind = {
            let (domain, robot) = (domain.clone(), robot.to_owned());
            move || {
                let (folder, listener) = bind(&domain, Server::Recorder, &robot)?;
                listener.set_nonblocking(true)?;
                Ok::<_, io::Error>((folder.socket(Server::Recorder, &robot), folder, listener))
            }
        };
        let name = format!("{robot}.{}.sock", Server::Recorder.word());
        let path = domain.base.join(&domain.name).join(name);
        let mut bound = bind()?;
        let (orders, asked) = std_mpsc::channel();
        let stop = Arc::new(AtomicBool::new(false));
        let is_stopped = Arc::clone(&stop);
        let thread = thread::Builder::new()
            .name("control".into())
            .spawn(move || {
                while !is_stopped.load(Relaxed) {
                    let Ok((client, _)) = bound.2.accept() else {
                        // Nobody is there, or no descriptor is free.
                        thread::sleep(TURN);
                        if !path.exists()
                            && let Ok(new) = bind()
                        {
                            bound = new;
                        }
                        continue;
                    };
                    let Some(order) = Self::order(&client) else {
                        continue;
                    };
                    let client = Asking(client);
                    match order {
                        Ok(()) => drop(orders.send(client)),
                        Err(error) => client.answer(Err(&error)),
                    }
                }
                let _ = fs::remove_file(bound.0);
            })?;
        Ok(Self {
            asked,
            stop,
            thread: Some(thread),
        })
    }

    /// The order of a client; `None` if it has left, or is too slow.
    fn order(client: &net::UnixStream) -> Option<Result<(), String>> {
        client.set_nonblocking(false).ok()?;
        client.set_read_timeout(Some(Duration::from_secs(1))).ok()?;
        client
            .set_write_timeout(Some(Duration::from_secs(1)))
            .ok()?;
        let mut line = String::new();
        let mut reader = BufReader::new(client).take(MAX_LINE as u64);
        reader.read_line(&mut line).ok()?;
        let order = serde_json::from_str::<Json>(&line).ok();
        Some(
            match order.is_some_and(|order| order == json!({ "do": "snapshot" })) {
                true => Ok(()),
                false => Err("a recorder knows {\"do\": \"snapshot\"} alone".to_owned()),
            },
        )
    }

    /// The next client that waits.
    pub fn asked(&mut self) -> Option<Asking> {
        self.asked.try_recv().ok()
    }
}

impl Drop for RecorderSocket {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The folder of a domain. Sockets are reached through its descriptor, because their paths may have
/// at most 107 bytes, and those of folder and robot may be longer.
struct DomainFolder(File);

impl DomainFolder {
    fn open(domain: &DomainConfig) -> io::Result<Self> {
        File::open(domain.base.join(&domain.name)).map(Self)
    }

    fn path(&self, name: &str) -> PathBuf {
        PathBuf::from(format!("/proc/self/fd/{}", self.0.as_raw_fd())).join(name)
    }

    fn socket(&self, server: Server, robot: &str) -> PathBuf {
        self.path(&format!("{robot}.{}.sock", server.word()))
    }
}

async fn serve(listener: UnixListener, orders: mpsc::Sender<Asked>) {
    let places = Arc::new(Semaphore::new(MAX_CLIENTS));
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            // No descriptor is free: do not ask again at once.
            sleep(Duration::from_millis(100)).await;
            continue;
        };
        let (orders, place) = (orders.clone(), Arc::clone(&places).try_acquire_owned());
        tokio::spawn(async move {
            match place {
                Ok(_place) => attend(&stream, &orders).await,
                Err(_) => {
                    let full = refusal(&format!("{MAX_CLIENTS} clients are there already"));
                    send(&stream, &full).await
                }
            }
        });
    }
}

/// Serves one client until it leaves, or is too slow.
async fn attend(stream: &UnixStream, orders: &mpsc::Sender<Asked>) -> Option<()> {
    let mut lines = LineBuffer::default();
    loop {
        let line = timeout(PATIENCE, lines.next(stream)).await.ok()?.ok()??;
        let order = match line.len() {
            0..=MAX_LINE => ControlOrder::parse(&line),
            _ => Err(format!("a line has at most {MAX_LINE} bytes")),
        };
        let answer = match order {
            Ok(order) => carry_out(order, orders).await,
            Err(error) => refusal(&error),
        };
        send(stream, &answer).await?;
    }
}

/// The answer of the control plane.
async fn carry_out(order: ControlOrder, orders: &mpsc::Sender<Asked>) -> Json {
    let (answer, answered) = oneshot::channel();
    let sent = orders.send(Asked { order, answer }).await;
    match answered.await {
        Ok(answer) if sent.is_ok() => answer,
        _ => refusal(&"the gateway is stopping"),
    }
}

/// Sends a line; `None` if the client does not take it.
async fn send(stream: &UnixStream, answer: &Json) -> Option<()> {
    let line = format!("{answer}\n");
    let all = async {
        let mut rest = line.as_bytes();
        while !rest.is_empty() {
            stream.writable().await?;
            match stream.try_write(rest) {
                Ok(sent) => rest = rest.get(sent..).unwrap_or_default(),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    };
    timeout(PATIENCE, all).await.ok()?.ok()
}

/// The bytes of a client that are not yet taken as lines.
#[derive(Default)]
struct LineBuffer {
    waiting: Vec<u8>,
}

impl LineBuffer {
    /// The next line, without its end; `None` at the end of the stream. Of one that is too long,
    /// a part that is too long, too.
    async fn next(&mut self, stream: &UnixStream) -> io::Result<Option<Vec<u8>>> {
        let mut part = [0; 1024];
        loop {
            if let Some(end) = self.waiting.iter().position(|byte| *byte == b'\n') {
                let mut line: Vec<u8> = self.waiting.drain(..=end).collect();
                line.pop();
                return Ok(Some(line));
            }
            // Enough to be too long; what follows is forgotten up to the end of the line.
            self.waiting.truncate(MAX_LINE + 1);
            stream.readable().await?;
            match stream.try_read(&mut part) {
                Ok(0) => return Ok(None),
                Ok(count) => self.waiting.extend(part.iter().take(count)),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
        }
    }
}

// ---------------------------------------------------------------- the operator's end

/// The robots whose gateways, or recorders, can be asked, by name.
///
/// # Errors
/// [`io::Error`]: the domain's folder or a socket is another user's
/// ([`io::ErrorKind::PermissionDenied`]), or cannot be read.
pub fn running(domain: &DomainConfig, server: Server) -> io::Result<Vec<String>> {
    let none = |error: io::Error| match error.kind() {
        // Nobody has been here, or nobody listens on what a killed gateway has left.
        io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused => Ok(false),
        _ => Err(error),
    };
    let folder = match DomainFolder::open(domain) {
        Ok(folder) => folder,
        Err(error) => return none(error).map(|_| Vec::new()),
    };
    let mut robots = Vec::new();
    let suffix = format!(".{}.sock", server.word());
    for entry in fs::read_dir(folder.path(""))? {
        let name = entry?.file_name();
        let Some(robot) = name.to_str().and_then(|name| name.strip_suffix(&suffix)) else {
            continue;
        };
        let connected = net::UnixStream::connect(folder.socket(server, robot));
        if connected.map(|_| true).or_else(none)? {
            robots.push(robot.to_owned());
        }
    }
    robots.sort();
    Ok(robots)
}

/// Asks the gateway, or the recorder, of `robot` with one line of JSON, and waits for its answer, a
/// line too.
///
/// # Errors
/// [`io::Error`]: none of this robot is there ([`io::ErrorKind::NotFound`],
/// [`io::ErrorKind::ConnectionRefused`]), or it does not answer.
pub fn ask(domain: &DomainConfig, server: Server, robot: &str, line: &str) -> io::Result<String> {
    let mut stream = net::UnixStream::connect(DomainFolder::open(domain)?.socket(server, robot))?;
    stream.set_read_timeout(Some(server.patience()))?;
    stream.set_write_timeout(Some(server.patience()))?;
    stream.write_all(format!("{line}\n").as_bytes())?;
    let mut answer = String::new();
    match BufReader::new(stream).read_line(&mut answer)? {
        0 => Err(io::ErrorKind::UnexpectedEof.into()),
        _ => Ok(answer.trim_end().to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The longest folder, domain and robot make a path longer than a socket may have.
    #[test]
    fn the_longest_names_have_a_socket() {
        let base = tempfile::tempdir().unwrap();
        let fill = 65 - base.path().as_os_str().len() - 1;
        let domain = DomainConfig::new(base.path().join("b".repeat(fill)), &"d".repeat(32));
        let robot = "r".repeat(64);
        let folder = domain.base.join(&domain.name);
        // What a gateway has left that was killed on the way.
        let left = folder.join(format!("{robot}.gateway.new"));
        fs::create_dir_all(&left).unwrap();
        fs::write(left.join("socket"), "").unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(async {
            let (orders, mut asked) = mpsc::channel(1);
            let socket = Socket::open(&domain, &robot, orders).unwrap();
            let (there, who) = (domain.clone(), robot.clone());
            let client = tokio::task::spawn_blocking(move || {
                (
                    running(&there, Server::Gateway),
                    ask(&there, Server::Gateway, &who, "{\"do\": \"status\"}"),
                )
            });
            let Asked { order, answer } = asked.recv().await.unwrap();
            assert_eq!(order, ControlOrder::Status);
            answer.send(json!({ "ok": true })).unwrap();
            let (found, answer) = client.await.unwrap();
            assert_eq!(
                (found.unwrap(), answer.unwrap().as_str()),
                (vec![robot.clone()], "{\"ok\":true}")
            );
            let names = || fs::read_dir(&folder).unwrap().count();
            assert_eq!(names(), 1, "the socket alone");
            drop(socket);
            assert_eq!(names(), 0);
        });
    }

    #[test]
    fn a_wrong_line_says_what_would_be_right() {
        let device = || "a".to_owned();
        let tare = ControlOrder::Tare { device: device() };
        let calibration = ControlOrder::Calibration { device: device() };
        for (line, order) in [
            (r#"{"do": "status"}"#, ControlOrder::Status),
            (r#" { "do" : "devices" } "#, ControlOrder::Devices),
            (r#"{"device": "a", "do": "tare"}"#, tare),
            (r#"{"do": "calibration", "device": "a"}"#, calibration),
        ] {
            assert_eq!(ControlOrder::parse(line.as_bytes()), Ok(order));
        }
        for (line, parts) in [
            ("", &["a JSON object such as {\"do\": \"status\"}"][..]),
            ("\u{0}", &["such as"]),
            ("[1]", &["such as"]),
            (r#"{"do": 1}"#, &["such as"]),
            (
                r#"{"do": "status", "robot": "r"}"#,
                &["unknown field `robot`"],
            ),
            (r#"{"device": "a"}"#, &["missing field `do`"]),
            (r#"{"do": "tare"}"#, &["tare needs a device"]),
            (r#"{"do": "calibration"}"#, &["calibration needs a device"]),
            (
                r#"{"do": "status", "device": "a"}"#,
                &["status takes no device"],
            ),
            (
                r#"{"do": "tara", "device": "a"}"#,
                &[
                    "no order \"tara\"",
                    "did you mean \"tare\"?",
                    "status, devices, tare, calibration, reload",
                ],
            ),
            (r#"{"do": "zzz"}"#, &["no order \"zzz\"; there is status"]),
        ] {
            let error = ControlOrder::parse(line.as_bytes()).expect_err(line);
            for part in parts {
                assert!(error.contains(part), "{line}: {error}");
            }
        }
        assert!(ControlOrder::parse(&[0xFF, 0xFE]).is_err());
    }
}
