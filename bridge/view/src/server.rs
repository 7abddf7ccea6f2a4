//! The server of Foxglove's WebSocket protocol, as a sink for the robot's messages.
//!
//! Each topic sends at most so often; between, its newest message replaces the one that waits. What
//! a client cannot take in time is dropped by the server, the oldest first: nothing grows.

use foxglove::messages::SceneUpdate;
use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{
    ChannelBuilder, Context, Encode, FoxgloveError, PartialMetadata, RawChannel, Schema,
    WebSocketServer, WebSocketServerHandle,
};
use proprio_bridge::MessageSink;
use proprio_bridge::cdr::CdrMessage;
use proprio_bridge::definitions::{Definition, MESSAGE, SCHEMA, string};
use proprio_topics::Nanos;
use std::convert::Infallible;
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;

/// A topic, and its newest message while that may not be sent yet.
struct ServedTopic {
    channel: Arc<RawChannel>,
    /// When the next message may be sent (CLOCK_MONOTONIC).
    due: Nanos,
    /// The wall clock's time of the message that waits.
    waiting: Option<u64>,
    bytes: Vec<u8>,
}

/// The topics of the server.
pub(crate) struct ServedTopics {
    context: Arc<Context>,
    period: Nanos,
    topics: Vec<ServedTopic>,
}

impl ServedTopics {
    /// None yet; each sends at most once per `period`.
    pub(crate) fn new(period: Nanos) -> Self {
        Self {
            context: Context::new(),
            period,
            topics: Vec::new(),
        }
    }

    /// Serves them. `urdf` is sent to whoever subscribes to `/robot_description`, `meshes` are the
    /// folders that hold the packages of its meshes.
    ///
    /// # Errors
    /// The port cannot be opened.
    pub(crate) fn serve(
        &mut self,
        address: IpAddr,
        port: u16,
        urdf: Option<&str>,
        meshes: Vec<PathBuf>,
    ) -> Result<WebSocketServerHandle, FoxgloveError> {
        let host = match address {
            IpAddr::V4(address) => address.to_string(),
            IpAddr::V6(address) => format!("[{address}]"),
        };
        let mut server = WebSocketServer::new()
            .context(&self.context)
            .name("proprio-view")
            .bind(host, port);
        if let Some(urdf) = urdf {
            let mut message = CdrMessage::new();
            message.text(urdf);
            let number = self.topic("/robot_description", MESSAGE, schema(&string()));
            if let Some(topic) = number.and_then(|number| self.topics.get(number)) {
                server = server.listener(Arc::new(Latched {
                    channel: Arc::clone(&topic.channel),
                    message,
                }));
            }
        }
        if !meshes.is_empty() {
            server = server.fetch_asset_handler_blocking_fn(move |_, uri| mesh(&meshes, &uri));
        }
        server.start_blocking()
    }

    /// The number of a topic, which is added if it is new or has another schema than before.
    fn topic(&mut self, topic: &str, encoding: &str, schema: Schema) -> Option<usize> {
        let known = (self.topics.iter()).position(|known| known.channel.topic() == topic);
        if let Some(number) = known
            && let Some(known) = self.topics.get(number)
        {
            if known.channel.schema() == Some(&schema) {
                return Some(number);
            }
            known.channel.close();
        }
        let builder = ChannelBuilder::new(topic).context(&self.context);
        let channel = builder.message_encoding(encoding).schema(schema);
        let new = ServedTopic {
            channel: channel.build_raw().ok()?,
            due: Nanos::MIN,
            waiting: None,
            bytes: Vec::new(),
        };
        match known.and_then(|number| self.topics.get_mut(number)) {
            Some(topic) => *topic = new,
            None => self.topics.push(new),
        }
        known.or(self.topics.len().checked_sub(1))
    }

    /// Sends a scene of the instant `wall` \[ns since 1970, UTC\] on a topic.
    pub(crate) fn scene(&mut self, topic: &str, wall: u64, scene: &SceneUpdate) {
        let encoding = SceneUpdate::get_message_encoding();
        let number = SceneUpdate::get_schema().and_then(|it| self.topic(topic, &encoding, it));
        if let Some(topic) = number.and_then(|number| self.topics.get_mut(number)) {
            topic.put(wall, |bytes| {
                bytes.reserve(scene.encoded_len().unwrap_or_default());
                // A `Vec` has room for every message.
                let _ = scene.encode(bytes);
            });
        }
    }

    /// Sends what waits and is due. `now` is CLOCK_MONOTONIC.
    pub(crate) fn flush(&mut self, now: Nanos) {
        for topic in &mut self.topics {
            if now >= topic.due
                && let Some(wall) = topic.waiting.take()
            {
                let metadata = PartialMetadata::with_log_time(wall);
                topic.channel.log_with_meta(&topic.bytes, metadata);
                // From when it was due, so that the rate is kept on average.
                let next = topic.due.saturating_add(self.period);
                topic.due = if next > now { next } else { now + self.period };
            }
        }
    }
}

impl ServedTopic {
    /// Replaces the message that waits, if anybody listens.
    fn put(&mut self, wall: u64, write: impl FnOnce(&mut Vec<u8>)) {
        self.waiting = self.channel.has_sinks().then_some(wall);
        if self.waiting.is_some() {
            self.bytes.clear();
            write(&mut self.bytes);
        }
    }
}

fn schema(definition: &Definition) -> Schema {
    let text = definition.text.clone().into_bytes();
    Schema::new(&definition.name, SCHEMA, text)
}

impl MessageSink for ServedTopics {
    type Channel = usize;
    type Error = Infallible;

    fn add(
        &mut self,
        topic: &str,
        definition: &Definition,
        _series: Option<usize>,
    ) -> Result<Option<usize>, Infallible> {
        Ok(self.topic(topic, MESSAGE, schema(definition)))
    }

    fn send(&mut self, channel: &usize, wall: u64, message: &CdrMessage) -> Result<(), Infallible> {
        if let Some(topic) = self.topics.get_mut(*channel) {
            topic.put(wall, |bytes| bytes.extend(message.bytes()));
        }
        Ok(())
    }
}

/// A message that each subscriber is sent once.
struct Latched {
    channel: Arc<RawChannel>,
    message: CdrMessage,
}

impl ServerListener for Latched {
    fn on_subscribe(&self, client: Client, channel: ChannelView<'_>) {
        if channel.id() == self.channel.id() {
            let sink = client.sink_id();
            self.channel.log_to_sink(self.message.bytes(), sink);
        }
    }
}

/// The file of `package://NAME/PATH`: `NAME/PATH` in one of the folders, and nothing outside them.
fn mesh(folders: &[PathBuf], uri: &str) -> Result<Vec<u8>, String> {
    let path = uri.strip_prefix("package://");
    let path = path.ok_or_else(|| format!("{uri}: only package:// is served"))?;
    let found = folders.iter().find_map(|folder| {
        let folder = folder.canonicalize().ok()?;
        let file = folder.join(path).canonicalize().ok()?;
        file.starts_with(folder).then_some(file)
    });
    let file = found.ok_or_else(|| format!("{uri}: no folder of --meshes holds it"))?;
    std::fs::read(&file).map_err(|error| format!("{}: {error}", file.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn meshes_are_served_from_their_folders_alone() {
        let root = std::env::temp_dir().join(format!("proprio-view-{}", std::process::id()));
        let folder = root.join("share");
        std::fs::create_dir_all(folder.join("arm/meshes")).expect("a folder");
        std::fs::write(folder.join("arm/meshes/link.stl"), "solid").expect("a file");
        std::fs::write(root.join("secret"), "no").expect("a file");
        let folders = [root.join("nothing"), folder];
        let get = |uri| mesh(&folders, uri);
        assert_eq!(get("package://arm/meshes/link.stl"), Ok(b"solid".to_vec()));
        for uri in [
            "package://arm/../../secret",
            "package:///etc/passwd",
            "package://arm/meshes/other.stl",
            "file:///etc/passwd",
        ] {
            assert!(get(uri).is_err(), "{uri}");
        }
        std::fs::remove_dir_all(root).expect("its own folder");
    }
}
