//! Drivers and boards built from TOML as in the gateway, and a bus between them that can lose
//! frames.

use proprio_drivers::{
    Board, Decoded, Device, Fault, Format, Frame, Frames, Id, Mode, NotSent, Options, Outputs,
    Spec, SpecError, StampedReading, State,
};
use proprio_topics::{
    Actuator, Counter, Imu, JointState, Nanos, Quality, Reading, StampKind, Wrench,
};

/// The keys of a driver, read from TOML.
pub(crate) fn options(driver: &str, keys: &str) -> Options {
    let table: toml::Table = keys.parse().expect("test keys are TOML");
    match Options::deserialize(driver, table) {
        Ok(mut options) => {
            if options.description().is_some() {
                options.describe(crate::dbc::messages());
            }
            options
        }
        Err(error) => panic!("{driver}: {error:?}"),
    }
}

/// The keys that the page of a driver shows.
pub(crate) fn shown_keys(page: &str) -> &str {
    let block = page.split("```toml\n").nth(1).expect("a block of keys");
    block.split("```\n").next().unwrap_or_default()
}

/// A device at `address` with a maximum silence of 50 ms.
pub(crate) fn spec(address: u32, mode: Mode, outputs: &[u8]) -> Spec {
    let outputs = Outputs(outputs.iter().copied().collect());
    Spec {
        address,
        max_silence: Nanos::from_millis(50),
        mode,
        outputs,
    }
}

fn device(driver: &str, keys: &str, mode: Mode, outputs: &[u8]) -> Box<dyn Device> {
    let options = options(driver, keys);
    let address = options.default_address().unwrap_or(1);
    options
        .device(&spec(address, mode, outputs))
        .expect("a legal configuration")
}

/// A device that only listens.
pub(crate) fn listener(driver: &str, keys: &str, outputs: &[u8]) -> Box<dyn Device> {
    device(driver, keys, Mode::Listen, outputs)
}

/// A device that commands its board.
pub(crate) fn supervisor(driver: &str, keys: &str, outputs: &[u8]) -> Box<dyn Device> {
    device(driver, keys, Mode::Supervise, outputs)
}

/// What the device sends at `t`.
pub(crate) fn poll(device: &mut dyn Device, t: Nanos) -> Option<Frame> {
    let transmit = device.poll_transmit(t, &mut Decoded::new());
    transmit.map(|transmit| transmit.frame)
}

/// CAN FD, with the higher bit rate.
pub(crate) const FD: Format = Format::Fd {
    bit_rate_switch: true,
    error_state: false,
};

/// Frames in can-utils' format.
pub(crate) fn texts(frames: &[Frame]) -> Vec<String> {
    frames.iter().map(ToString::to_string).collect()
}

/// A board.
pub(crate) fn board(driver: &str, keys: &str, outputs: &[u8]) -> Box<dyn Board> {
    let options = options(driver, keys);
    let address = options.default_address().unwrap_or(1);
    options
        .board(&spec(address, Mode::Supervise, outputs))
        .expect("a legal configuration")
}

/// The frame `text` in can-utils' format, received at `ms`.
pub(crate) fn frame(text: &str, ms: f64) -> Frame {
    let (id, data) = text.split_once('#').expect("id#data");
    let bytes: Vec<u8> = (0..data.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&data[at..at + 2], 16).unwrap())
        .collect();
    let raw = u32::from_str_radix(id, 16).unwrap();
    let id = match id.len() {
        8 => Id::extended(raw),
        _ => Id::standard(u16::try_from(raw).unwrap()),
    };
    Frame::new(id, &bytes).at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
}

/// The readings and faults decoded from `frames`, in order.
pub(crate) fn decode(
    device: &mut dyn Device,
    frames: &[Frame],
) -> (Vec<StampedReading>, Vec<Fault>) {
    let (mut readings, mut faults) = (Vec::new(), Vec::new());
    let mut out = Decoded::new();
    for frame in frames {
        out.clear();
        device.on_frame(frame, &mut out);
        readings.extend(out.readings.iter().copied());
        faults.extend(out.faults.iter().copied());
    }
    (readings, faults)
}

/// The total of `counter`.
pub(crate) fn count(faults: &[Fault], counter: Counter) -> u32 {
    faults
        .iter()
        .filter(|fault| fault.counter == counter)
        .map(|fault| fault.count)
        .sum()
}

/// The frames that `reading` is encoded to.
pub(crate) fn encode(
    board: &mut dyn Board,
    output: u8,
    reading: &Reading,
    quality: Quality,
) -> Vec<Frame> {
    let mut out = Frames::new();
    board
        .encode(output, reading, quality, &mut out)
        .expect("a reading that this board has");
    out.to_vec()
}

/// Whether this frame, the n-th of one side, is lost.
type Loss = Box<dyn FnMut(usize, &Frame) -> bool>;

/// Why the host's interface does not send this frame, if it does not.
type Outage = Box<dyn FnMut(&Frame) -> Option<NotSent>>;

/// One device and one board on a bus, with turns of 1 ms.
pub(crate) struct Rig {
    pub(crate) device: Box<dyn Device>,
    pub(crate) board: Box<dyn Board>,
    /// The board's measurement.
    pub(crate) reading: (u8, Reading),
    pub(crate) now: Nanos,
    /// The host's interface.
    pub(crate) interface: Outage,
    /// What it did not send, and when.
    pub(crate) unsent: Vec<(Nanos, String)>,
    /// Frames of the host that are lost.
    pub(crate) host_loses: Loss,
    /// Frames of the board that are lost.
    pub(crate) board_loses: Loss,
    /// All frames that the host's interface sent, lost or not.
    pub(crate) sent: Vec<String>,
    pub(crate) received: usize,
    pub(crate) readings: Vec<StampedReading>,
    pub(crate) faults: Vec<Fault>,
    /// The sequence of states, without repetition.
    pub(crate) states: Vec<State>,
    due: Option<Nanos>,
}

impl Rig {
    /// A device and a board with the same keys.
    pub(crate) fn new(driver: &str, keys: &str, outputs: &[u8], reading: (u8, Reading)) -> Self {
        Self::with_board(driver, keys, keys, outputs, reading)
    }

    /// A board that another program has started, and a device in `mode`.
    pub(crate) fn started(driver: &str, keys: &str, mode: Mode, reading: (u8, Reading)) -> Self {
        let mut rig = Self::new(driver, keys, &[], reading);
        let options = options(driver, keys);
        let address = options.default_address().unwrap_or(1);
        rig.device = options
            .device(&spec(address, mode, &[]))
            .expect("a legal configuration");
        rig.board = options
            .board(&spec(address, Mode::Listen, &[]))
            .expect("a legal configuration");
        rig
    }

    /// A device and a board with different keys.
    pub(crate) fn with_board(
        driver: &str,
        keys: &str,
        board_keys: &str,
        outputs: &[u8],
        reading: (u8, Reading),
    ) -> Self {
        let host = options(driver, keys);
        let address = host.default_address().unwrap_or(1);
        let spec = spec(address, Mode::Supervise, outputs);
        Self {
            device: host.device(&spec).expect("a legal configuration"),
            board: options(driver, board_keys)
                .board(&spec)
                .expect("a legal configuration"),
            reading,
            now: Nanos::from_millis(1000),
            interface: Box::new(|_| None),
            unsent: Vec::new(),
            host_loses: Box::new(|_, _| false),
            board_loses: Box::new(|_, _| false),
            sent: Vec::new(),
            received: 0,
            readings: Vec::new(),
            faults: Vec::new(),
            states: Vec::new(),
            due: None,
        }
    }

    fn deliver(&mut self, frames: &[Frame]) {
        for frame in frames {
            self.received += 1;
            if (self.board_loses)(self.received, frame) {
                continue;
            }
            let mut out = Decoded::new();
            self.device
                .on_frame(&frame.at(self.now, StampKind::Software), &mut out);
            self.readings.extend(out.readings);
            self.faults.extend(out.faults);
        }
    }

    fn note(&mut self) {
        let state = self.device.state();
        if self.states.last() != Some(&state) {
            self.states.push(state);
        }
    }

    /// Lets `ms` milliseconds pass.
    pub(crate) fn run(&mut self, ms: u32) -> &mut Self {
        for _ in 0..ms {
            let mut out = Decoded::new();
            let (output, reading) = self.reading;
            self.board.present(output, &reading, Quality::GOOD);
            while let Some(transmit) = self.device.poll_transmit(self.now, &mut out) {
                assert!(transmit.deadline > self.now, "a frame after its deadline");
                let under_way = self.device.poll_transmit(self.now, &mut out);
                assert_eq!(under_way, None, "the last frame is still under way");
                let outcome = (self.interface)(&transmit.frame).map_or(Ok(self.now), Err);
                self.device.on_sent(&transmit.frame, outcome);
                if outcome.is_err() {
                    self.unsent.push((self.now, transmit.frame.to_string()));
                    continue;
                }
                self.sent.push(transmit.frame.to_string());
                assert!(self.sent.len() < 10_000, "it never stops sending");
                if (self.host_loses)(self.sent.len(), &transmit.frame) {
                    continue;
                }
                let mut answers = Frames::new();
                self.board.on_frame(&transmit.frame, &mut answers);
                self.deliver(&answers);
            }
            self.faults.extend(out.faults);
            self.note();
            match self.board.period() {
                None => self.due = None,
                Some(period) => {
                    let due = *self.due.get_or_insert(self.now);
                    if self.now >= due {
                        self.due = Some(due + period);
                        let frames = encode(&mut *self.board, output, &reading, Quality::GOOD);
                        self.deliver(&frames);
                    }
                }
            }
            self.note();
            self.now += Nanos::from_millis(1);
        }
        self
    }

    /// The board is lost, comes back, frames are lost, and the device is restarted and stopped:
    /// then it sends nothing.
    pub(crate) fn disturb(&mut self) {
        self.board_loses = Box::new(|_, _| true);
        self.run(1000);
        self.board_loses = Box::new(|n, _| n % 3 == 0);
        self.run(300);
        self.device.restart(self.now);
        self.run(300);
        self.device.stop(self.now);
        let before = self.sent.len();
        self.run(100);
        assert_eq!(self.sent.len(), before);
        assert_eq!(self.device.state(), State::Stopped);
    }

    pub(crate) fn count(&self, counter: Counter) -> u32 {
        count(&self.faults, counter)
    }
}

/// The states of joints among `readings`.
pub(crate) fn joints(readings: &[StampedReading]) -> Vec<(JointState, Quality)> {
    (readings.iter())
        .filter_map(|stamped| match stamped.reading {
            Reading::Joint(joint) if stamped.output == 0 => Some((joint, stamped.quality)),
            _ => None,
        })
        .collect()
}

/// The temperatures among `readings`, with the numbers of their outputs.
pub(crate) fn temperatures(readings: &[StampedReading]) -> Vec<(u8, f64)> {
    (readings.iter())
        .filter_map(|stamped| match stamped.reading {
            Reading::Temperature(temperature) => Some((stamped.output, temperature.celsius)),
            _ => None,
        })
        .collect()
}

/// Whether the numbers are the same but for their rounding.
pub(crate) fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-9 * b.abs().max(1.0)
}

/// Whether the first joint reading of this frame is SATURATED, which is counted too.
pub(crate) fn is_saturated(device: &mut dyn Device, text: &str) -> bool {
    let (readings, faults) = decode(device, &[frame(text, 0.0)]);
    let saturated = joints(&readings)[0].1.contains(Quality::SATURATED);
    assert_eq!(count(&faults, Counter::Saturated), u32::from(saturated));
    saturated
}

/// Frames with `id` that are no classic ones of eight bytes are counted, and give no readings.
pub(crate) fn takes_eight_bytes(device: &mut dyn Device, id: Id, fill: u8) {
    let mut counted = |frame, counter| {
        let (readings, faults) = decode(device, &[frame]);
        assert_eq!((readings.len(), count(&faults, counter)), (0, 1), "{frame}");
    };
    for length in 0..8 {
        counted(Frame::new(id, &[fill; 8][..length]), Counter::Length);
    }
    counted(Frame::remote(id, 8), Counter::Length);
    let fd = Frame::with_format(id, FD, &[fill; 8]).unwrap();
    counted(fd, Counter::Value);
}

/// What `device` sends in `ms` milliseconds from `from_ms` on, without any answer.
pub(crate) fn sent(device: &mut dyn Device, from_ms: i64, ms: i64) -> Vec<String> {
    let mut sent = Vec::new();
    for now in (from_ms..from_ms + ms).map(Nanos::from_millis) {
        while let Some(frame) = poll(device, now) {
            device.on_sent(&frame, Ok(now));
            sent.push(frame.to_string());
        }
    }
    sent
}

/// `device` never sends anything, stopped or not.
pub(crate) fn sends_nothing(device: &mut dyn Device) {
    assert_eq!(sent(device, 1000, 3000), [""; 0]);
    device.stop(Nanos::from_millis(5000));
    assert_eq!(sent(device, 5000, 100), [""; 0]);
}

/// What `board` answers to the frame `text`.
pub(crate) fn asked(board: &mut dyn Board, text: &str) -> Vec<String> {
    let mut out = Frames::new();
    board.on_frame(&frame(text, 0.0), &mut out);
    texts(&out)
}

/// A drive's state, without a duty cycle.
pub(crate) fn actuator(mode: u32, faults: u32) -> Reading {
    Reading::Actuator(Actuator {
        duty: 0.0,
        mode,
        encoder: 0,
        faults,
    })
}

/// The key that device and board refuse, or the legal addresses.
pub(crate) fn refused(driver: &str, keys: &str, address: u32) -> String {
    let options = options(driver, keys);
    let spec = spec(address, Mode::Listen, &[0]);
    let error = options.device(&spec).map(|_| ()).unwrap_err();
    let board = options.board(&spec).map(|_| ()).unwrap_err();
    assert_eq!(board.to_string(), error.to_string());
    match error {
        SpecError::Key { key, .. } | SpecError::Keys { key, .. } => key.to_owned(),
        SpecError::Address { least, most, .. } => format!("{least} to {most}"),
        other => panic!("{other:?}"),
    }
}

pub(crate) fn joint(reading: &Reading) -> JointState {
    match reading {
        Reading::Joint(joint) => *joint,
        other => panic!("{other:?}"),
    }
}

pub(crate) fn imu(stamped: &StampedReading) -> Imu {
    match stamped.reading {
        Reading::Imu(imu) => imu,
        other => panic!("{other:?}"),
    }
}

pub(crate) fn wrench(reading: &Reading) -> Wrench {
    match reading {
        Reading::Wrench(wrench) => *wrench,
        other => panic!("{other:?}"),
    }
}

pub(crate) fn reading(force: [f64; 3], torque: [f64; 3]) -> Reading {
    Reading::Wrench(Wrench { force, torque })
}

/// Why `driver` refuses `keys` at `address`.
pub(crate) fn refused_at(driver: &str, keys: &str, address: u32) -> SpecError {
    let options = options(driver, keys);
    let spec = spec(address, Mode::Supervise, &[]);
    let device = options.device(&spec).map(|_| ()).unwrap_err();
    let board = options.board(&spec).map(|_| ()).unwrap_err();
    assert_eq!(device, board);
    device
}
