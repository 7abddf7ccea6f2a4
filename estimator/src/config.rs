//! estimator.toml as typed ([`Config`]), with the meaning and default of every key.
//!
//! [`crate::setup`] checks it against the model and resolves names; the rest of the estimator uses
//! that form.

use proprio_dynamics::calibration::{Calibration, Gain, UNKNOWN_OFFSET, gain_from_force_first};
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame};
use proprio_dynamics::spatial::Wrench;
use proprio_identification::robot::{IdentificationInput, TorqueSide};
use proprio_topics::{ROBOT_NAME, is_robot_name};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Keys of earlier versions, and what to do about them.
const FORMER: [(&str, &str); 1] = [("model_std", "is now called `urdf_relative_std`: rename it")];

/// A configuration that cannot be used: exit 2.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", .file.display())]
pub struct InvalidConfig {
    /// The file.
    pub file: PathBuf,
    /// Where in the file, what is wrong, and what is allowed.
    pub problem: String,
}

/// The whole file.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The version of the file format: 1.
    pub schema: u32,
    /// The robot's name: the first part of every service's name.
    pub robot: String,
    /// The URDF, relative to this file.
    pub model: PathBuf,
    /// Identified parameters and offsets ([`crate::parameters`]), relative to this file. They
    /// replace the URDF's inertias and this file's offsets.
    pub parameters: Option<PathBuf>,
    /// How the estimator's thread is scheduled.
    pub realtime: Option<ThreadScheduling>,
    /// Where kinematics start.
    pub base: Base,
    /// Joints that are not measured, and their fixed positions \[rad or m\]. Joints that follow
    /// another one in the URDF (`<mimic>`) are neither measured nor locked; one that is named here
    /// does not follow.
    #[serde(default)]
    pub locked: BTreeMap<String, f64>,
    /// The force/torque sensors, at which the tree is cut.
    #[serde(default)]
    pub force_torque: Vec<ForceTorque>,
    /// The unknown external wrenches.
    #[serde(default)]
    pub contact: Vec<ContactSite>,
    /// Patches of tactile skin, which show where contacts are.
    #[serde(default)]
    pub skin: Vec<TactileSkin>,
    /// What is identified, and from which measurements.
    #[serde(default)]
    pub identification: Identification,
    /// How positions and angular velocities are differentiated.
    #[serde(default)]
    pub differentiation: Differentiation,
    /// How samples are accepted.
    #[serde(default)]
    pub input: Input,
    /// When and what is published.
    #[serde(default)]
    pub output: Publishing,
}

/// How a thread is scheduled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ThreadScheduling {
    /// The processor it is bound to.
    pub cpu: Option<usize>,
    /// Its SCHED_FIFO priority, 1 to 99.
    pub priority: Option<i32>,
}

/// Where kinematics start.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum Base {
    /// A link at rest. It implies an unknown wrench on that link: the ground reaction.
    Fixed {
        /// The link or folded frame.
        link: String,
        /// Physical gravity, pointing down, in the axes of `link` \[m/s^2\].
        #[serde(default = "standard_gravity", deserialize_with = "exactly")]
        gravity_mps2: [f64; 3],
    },
    /// One of several links is at rest, and which one changes: the feet of a walking robot.
    Stance {
        /// The links, in order of preference: the first whose contact is present is the base.
        foot: Vec<Foot>,
    },
    /// An IMU on a link. Without a contact on the part of the robot that has it, up to the F/T
    /// sensors, it implies an unknown wrench on that link, as a fixed base does.
    Imu {
        /// Its channel.
        sensor: String,
        /// The link or folded frame that it is mounted on.
        link: String,
        /// Its origin in that frame \[m\].
        #[serde(default, deserialize_with = "exactly")]
        xyz_m: [f64; 3],
        /// Its axes in that frame: roll, pitch, yaw about fixed axes, as in URDF \[rad\].
        #[serde(default, deserialize_with = "exactly")]
        rpy_rad: [f64; 3],
    },
}

/// A link that is at rest while its contact is present.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(deny_unknown_fields)]
pub struct Foot {
    /// The link or folded frame.
    pub link: String,
    /// Physical gravity, pointing down, in the axes of `link` while it is at rest \[m/s^2\].
    #[serde(default = "standard_gravity", deserialize_with = "exactly")]
    pub gravity_mps2: [f64; 3],
    /// The name of the contact, of kind `wrench` and on this link, that carries the robot there.
    pub contact: String,
}

/// Exactly `N` numbers: a plain array would silently take the first `N` of more.
pub(crate) fn exactly<'de, D: Deserializer<'de>, const N: usize>(
    deserializer: D,
) -> Result<[f64; N], D::Error> {
    let numbers = Vec::<f64>::deserialize(deserializer)?;
    let given = numbers.len();
    numbers
        .try_into()
        .map_err(|_| D::Error::custom(format!("{given} numbers where {N} are needed")))
}

pub(crate) fn exactly_if_given<'de, D: Deserializer<'de>, const N: usize>(
    deserializer: D,
) -> Result<Option<[f64; N]>, D::Error> {
    exactly(deserializer).map(Some)
}

/// \[m/s^2\]
pub const STANDARD_GRAVITY: f64 = 9.80665;

const fn standard_gravity() -> [f64; 3] {
    [0.0, 0.0, -STANDARD_GRAVITY]
}

/// A force/torque sensor.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ForceTorque {
    /// Its channel.
    pub sensor: String,
    /// The URDF joint that it is mounted in; the tree is cut here. If the joint moves, the sensor
    /// is on the side of its child.
    pub joint: String,
    /// The measurement frame: axes and origin of its reading; default: that of the URDF's sensor
    /// element, else `child`.
    #[cfg_attr(test, schemars(with = "Option<elsewhere::FrameWord>"))]
    pub frame: Option<MeasurementFrame>,
    /// The measurement direction: which link acts on which; default: that of the URDF's sensor
    /// element, else `child_to_parent`.
    #[cfg_attr(test, schemars(with = "Option<elsewhere::DirectionWord>"))]
    pub direction: Option<MeasurementDirection>,
    /// With `frame = "sensor"`: the sensor's origin in the child link's frame \[m\].
    #[serde(default, deserialize_with = "exactly_if_given")]
    pub xyz_m: Option<[f64; 3]>,
    /// With `frame = "sensor"`: the sensor's axes in the child link's frame: roll, pitch, yaw
    /// \[rad\].
    #[serde(default, deserialize_with = "exactly_if_given")]
    pub rpy_rad: Option<[f64; 3]>,
    /// Standard deviation of its forces, after `gain` \[N\]. The default is that of an iCub arm's
    /// sensor with the robot at rest.
    #[serde(default = "default_noise_n", deserialize_with = "exactly")]
    pub noise_n: [f64; 3],
    /// Standard deviation of its torques, after `gain` \[Nm\]. The default is that of the same
    /// sensor.
    #[serde(default = "default_noise_nm", deserialize_with = "exactly")]
    pub noise_nm: [f64; 3],
    /// Offset of its forces: its reading without load \[N\]. Default: unknown
    /// ([`UNKNOWN_OFFSET`]).
    #[serde(default, deserialize_with = "exactly_if_given")]
    pub offset_n: Option<[f64; 3]>,
    /// Offset of its torques: its reading without load \[Nm\]. Default: unknown
    /// ([`UNKNOWN_OFFSET`]).
    #[serde(default, deserialize_with = "exactly_if_given")]
    pub offset_nm: Option<[f64; 3]>,
    /// Standard deviation of `offset_n` \[N\]; default: 0 if `offset_n` is given.
    #[serde(default, deserialize_with = "exactly_if_given")]
    pub offset_std_n: Option<[f64; 3]>,
    /// Standard deviation of `offset_nm` \[Nm\]; default: 0 if `offset_nm` is given.
    #[serde(default, deserialize_with = "exactly_if_given")]
    pub offset_std_nm: Option<[f64; 3]>,
    /// Gain matrix that its readings are multiplied with first, in addition to the calibration in
    /// its board ([`proprio_dynamics::calibration`]): 36 numbers row by row, rows and columns
    /// `fx fy fz tx ty tz`, or the 6 of a diagonal; default: the identity.
    #[serde(default, deserialize_with = "gain_numbers")]
    pub gain: Option<Vec<f64>>,
    /// Temperature drift of its forces, which is subtracted: change per kelvin of its board above
    /// `reference_celsius` [N/K]. Default: none.
    #[serde(default, deserialize_with = "exactly")]
    pub temperature_n_per_k: [f64; 3],
    /// Temperature drift of its torques [Nm/K].
    #[serde(default, deserialize_with = "exactly")]
    pub temperature_nm_per_k: [f64; 3],
    /// The board temperature at which its offset is valid \[degrees Celsius\]. If temperature drift
    /// is identified and this is not given, it is the mean of the training logs.
    pub reference_celsius: Option<f64>,
}

fn gain_numbers<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Vec<f64>>, D::Error> {
    let numbers = Vec::<f64>::deserialize(deserializer)?;
    match numbers.len() {
        6 | 36 => Ok(Some(numbers)),
        given => Err(D::Error::custom(format!(
            "{given} numbers where 6 (a diagonal) or 36 (row by row) are needed"
        ))),
    }
}

const fn default_noise_n() -> [f64; 3] {
    [0.08, 0.09, 0.18]
}

const fn default_noise_nm() -> [f64; 3] {
    [0.002, 0.003, 0.0015]
}

/// An unknown external wrench.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ContactSite {
    /// Its name in tables and services; default: `link`.
    pub name: Option<String>,
    /// The link or folded frame that it acts on. Its wrench is given in the axes and at the origin
    /// of that frame.
    pub link: String,
    /// How many unknowns it has.
    #[serde(default)]
    pub kind: ContactModel,
    /// The direction of a `force_along`, in the frame's axes.
    #[serde(default, deserialize_with = "exactly_if_given")]
    pub direction: Option<[f64; 3]>,
    /// The point where it acts, in the frame's axes \[m\]. Possible contacts are distinguished by
    /// this point.
    #[serde(default, deserialize_with = "exactly")]
    pub position_m: [f64; 3],
    /// Whether it is always there.
    #[serde(default)]
    pub presence: Occurrence,
}

/// How many unknowns a contact has.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum ContactModel {
    /// A force and a torque: 6.
    #[default]
    Wrench,
    /// A force through `position_m`: 3.
    Force,
    /// A force through `position_m` along `direction`: 1.
    ForceAlong,
}

/// Whether a contact is always there.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "lowercase")]
pub enum Occurrence {
    /// It is always present, unless it is declared absent.
    #[default]
    Always,
    /// It is absent unless it is declared present, or F/T readings show it. Where they can not,
    /// because of a fault, and nobody declares it, nothing that rests on its absence is valid.
    Possible,
}

/// A patch of tactile skin ([`crate::skin`]): while it is touched, its contact is present, at the
/// place of the touch.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TactileSkin {
    /// Its channel.
    pub channel: String,
    /// The link or folded frame that its taxels are placed in.
    pub link: String,
    /// The contact, on the same link, that a touch belongs to.
    pub contact: String,
    /// The file of its taxels' positions and normals ([`crate::skin::TaxelMap`]), relative to this
    /// file.
    pub taxels: PathBuf,
    /// The number in that file of the first taxel of the channel's triangle 0: 192 for the second
    /// board of an iCub's limb. Default: 0.
    #[serde(default)]
    pub first_taxel: usize,
    /// Standard deviation of an untouched taxel's value, in its unit (iCub: counts). Measure it
    /// with the robot in motion and nobody near. Default: 1.
    #[serde(default = "one")]
    pub noise: f64,
    /// How many touches that are none the patch may show per hour. This and `noise` give the
    /// threshold of a taxel ([`crate::skin::threshold`]). Default: 1.
    #[serde(default = "one")]
    pub false_alarms_per_hour: f64,
    /// Standard deviation of a touch's position, each axis \[m\]. Default: the median distance of
    /// neighbouring taxels divided by the square root of 12.
    pub position_std_m: Option<f64>,
    /// The longest time without a reading of a triangle \[ms\]; default 250. A touch that was seen
    /// before a longer silence is not known any more: what depends on it is withheld.
    #[serde(default = "default_skin_silence_ms")]
    pub max_silence_ms: f64,
}

const fn one() -> f64 {
    1.0
}

const fn default_skin_silence_ms() -> f64 {
    250.0
}

/// `[identification]`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct Identification {
    /// Whether parameters are identified on-line.
    pub enabled: bool,
    /// From which measurements; default: the force/torque sensors. On-line they alone are used.
    #[cfg_attr(test, schemars(with = "Vec<elsewhere::InputWord>"))]
    pub inputs: Vec<IdentificationInput>,
    /// Where the joint torques used for identification are measured; default: on the link side of
    /// the gears.
    #[cfg_attr(test, schemars(with = "elsewhere::SideWord"))]
    pub torque_side: TorqueSide,
    /// Largest rate of on-line identification instants \[Hz\]; the trigger's rate if that is less.
    pub rate_hz: f64,
    /// The file that keeps the state of on-line identification between runs of the daemon, relative
    /// to this file; default: none. It has priority over `parameters`. A state that cannot be used
    /// is renamed, and identification starts without it.
    pub state: Option<PathBuf>,
    /// How often the state is written \[s\]. It is also written when the daemon ends.
    pub save_every_s: f64,
    /// Uncertainty of the URDF's inertial parameters of links that were not identified: the
    /// relative standard deviation of a link's mass, and of its mass distribution
    /// ([`proprio_identification::prior::link_cad_root`]). Torques that depend on such links get
    /// the corresponding standard deviation. 0: they are exact.
    pub urdf_relative_std: f64,
    /// Whether `proprio identify` also identifies the gain error of each force/torque sensor, and
    /// which entries of it.
    #[cfg_attr(test, schemars(with = "elsewhere::GainWord"))]
    pub gain: Gain,
    /// Prior standard deviation of a gain error, relative. It holds for diagonal entries, and for
    /// force-force and torque-torque cross-talk. For cross-talk of a torque into a force it is
    /// divided by the sensor's length, for a force into a torque multiplied by it. The length is
    /// the ratio of RMS `noise_nm` to RMS `noise_n`, which is about the ratio of the full scales.
    /// Where the logs show smaller errors, it is reduced, to a tenth at most (evidence).
    pub gain_std: f64,
    /// Whether `proprio identify` also identifies the drift of readings with the temperature of the
    /// sensor's board, if that was recorded.
    pub temperature: bool,
}

impl Default for Identification {
    fn default() -> Self {
        // Parts missing in CAD (cables, screws, insides of motors) are a tenth to a third of a
        // link's mass.
        Self {
            enabled: false,
            inputs: Vec::new(),
            torque_side: TorqueSide::Link,
            rate_hz: 100.0,
            state: None,
            save_every_s: 60.0,
            urdf_relative_std: 0.2,
            gain: Gain::Auto,
            gain_std: 0.05,
            temperature: false,
        }
    }
}

/// `[differentiation]`: velocities and accelerations from samples, by adaptive windows.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct Differentiation {
    /// Peak noise of a joint position: at least half its resolution \[rad or m\].
    pub position_noise_rad: f64,
    /// Peak noise of an IMU's angular velocity \[rad/s\].
    pub angular_velocity_noise_radps: f64,
    /// The longest window \[ms\].
    pub max_window_ms: f64,
}

impl Default for Differentiation {
    fn default() -> Self {
        // Half of 0.055 deg, iCub's coarsest encoders; and three times the noise density of a
        // BNO055 at 100 Hz.
        Self {
            position_noise_rad: 4.8e-4,
            angular_velocity_noise_radps: 5e-3,
            max_window_ms: 300.0,
        }
    }
}

/// `[input]`: how samples are accepted.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct Input {
    /// Longest time without a sample of a channel \[ms\]; after it, estimates that depend on the
    /// channel are withheld.
    pub max_silence_ms: f64,
}

impl Default for Input {
    fn default() -> Self {
        Self {
            max_silence_ms: 50.0,
        }
    }
}

/// `[output]`: when and what is published.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct Publishing {
    /// The trigger channel: each of its stamps gives one estimate. Default: the first force/torque
    /// sensor, else the first joint.
    pub trigger: Option<String>,
    /// How long an estimate waits for the samples of other channels, counted in stamps \[ms\]; at
    /// most 32 periods of the fastest channel. A dead channel costs this wait. The order of arrival
    /// does not matter, provided that no sample arrives more than half of this behind a later one.
    /// Default: it does not wait. The other channels are extrapolated to the trigger's sample, and
    /// the standard deviations include what that costs.
    pub max_wait_ms: Option<f64>,
    /// Whether an estimate waits at all; `max_wait_ms` says that already.
    pub timing: Option<Timing>,
    /// A joint torque whose standard deviation exceeds this is withheld \[Nm\]; default: the
    /// largest gravity load of the links beyond the joint, or a quarter of its effort limit if that
    /// is more ([`crate::setup::Setup::max_deviation`]).
    pub max_torque_std_nm: Option<f64>,
}

/// Whether an estimate waits for the samples of other channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "lowercase")]
pub enum Timing {
    /// It waits for `max_wait_ms`, by default 1 ms.
    Aligned,
    /// It does not wait.
    Immediate,
}

impl Publishing {
    /// How long an estimate waits for the samples of other channels \[ms\]; none: it does not.
    pub(crate) fn wait_ms(&self) -> Option<f64> {
        let least = (self.timing == Some(Timing::Aligned)).then_some(1.0);
        self.max_wait_ms.or(least)
    }
}

impl Config {
    /// Reads a configuration file; its paths become relative to where the file is.
    ///
    /// # Errors
    /// [`InvalidConfig`]: not readable, not TOML, an unknown key, a wrong value.
    pub fn load(file: &Path) -> Result<Self, InvalidConfig> {
        let error = |problem| InvalidConfig {
            file: file.to_owned(),
            problem,
        };
        let text =
            std::fs::read_to_string(file).map_err(|e| error(format!("cannot be read: {e}")))?;
        let mut config = Self::parse(&text).map_err(error)?;
        let folder = file.parent().unwrap_or(Path::new("."));
        config.model = folder.join(&config.model);
        config.parameters = config.parameters.map(|p| folder.join(p));
        for skin in &mut config.skin {
            skin.taxels = folder.join(&skin.taxels);
        }
        config.identification.state = config.identification.state.map(|p| folder.join(p));
        Ok(config)
    }

    /// Reads and checks a configuration given as text.
    ///
    /// # Errors
    /// A text that states what is wrong, where, and what is allowed.
    pub fn parse(text: &str) -> Result<Self, String> {
        let config: Self = toml::from_str(text).map_err(|e| {
            let problem = e.to_string();
            let mut former = FORMER.iter();
            match former.find(|(key, _)| problem.contains(&format!("unknown field `{key}`"))) {
                Some((key, what)) => format!("{problem}\n`{key}` {what}"),
                None => problem,
            }
        })?;
        config.check()?;
        Ok(config)
    }

    fn check(&self) -> Result<(), String> {
        if self.schema != 1 {
            return Err(format!(
                "schema = {} is not known; this version reads schema = 1",
                self.schema
            ));
        }
        if !is_robot_name(&self.robot) {
            return Err(format!("robot = {:?}: {ROBOT_NAME}", self.robot));
        }
        if let Some(priority) = self.realtime.and_then(|scheduling| scheduling.priority) {
            within("realtime.priority", priority, [1, 99])?;
        }
        let (wanted, identification) = (&self.differentiation, &self.identification);
        for (key, value, most) in [
            ("input.max_silence_ms", self.input.max_silence_ms, 3.6e6),
            (
                "differentiation.position_noise_rad",
                wanted.position_noise_rad,
                1.0,
            ),
            (
                "differentiation.angular_velocity_noise_radps",
                wanted.angular_velocity_noise_radps,
                10.0,
            ),
            ("differentiation.max_window_ms", wanted.max_window_ms, 1e4),
            (
                "output.max_torque_std_nm",
                self.output.max_torque_std_nm.unwrap_or(1.0),
                f64::MAX,
            ),
            ("identification.gain_std", identification.gain_std, 1.0),
        ] {
            positive(key, value, most)?;
        }
        for (key, value, range) in [
            (
                "identification.urdf_relative_std",
                identification.urdf_relative_std,
                [0.0, 2.0],
            ),
            (
                "identification.rate_hz",
                identification.rate_hz,
                [1.0, 1000.0],
            ),
            (
                "identification.save_every_s",
                identification.save_every_s,
                [1.0, 1e6],
            ),
            // Buffers for a waiting instant: 32 samples of a channel beside those of its window,
            // and 256 instants.
            (
                "output.max_wait_ms",
                self.output.max_wait_ms.unwrap_or(0.0),
                [0.0, 250.0],
            ),
        ] {
            within(key, value, range)?;
        }
        if self.output.timing == Some(Timing::Immediate) && self.output.max_wait_ms.is_some() {
            return Err(
                "output.max_wait_ms is of no use with timing = \"immediate\"; remove one of them, \
                 or set timing = \"aligned\""
                    .into(),
            );
        }
        self.base.check()?;
        for (joint, position) in &self.locked {
            finite(&format!("locked.{joint}"), &[*position])?;
        }
        self.force_torque.iter().try_for_each(ForceTorque::check)?;
        self.skin.iter().try_for_each(TactileSkin::check)?;
        self.contact.iter().try_for_each(ContactSite::check)
    }
}

fn positive(key: &str, value: f64, most: f64) -> Result<(), String> {
    if value > 0.0 && value <= most {
        Ok(())
    } else {
        Err(format!("{key} = {value} must be above 0, at most {most}"))
    }
}

fn within<T: PartialOrd + Display>(key: &str, value: T, range: [T; 2]) -> Result<(), String> {
    let [least, most] = range;
    if value >= least && value <= most {
        Ok(())
    } else {
        Err(format!("{key} = {value} must be {least} to {most}"))
    }
}

fn finite(key: &str, values: &[f64]) -> Result<(), String> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(format!("{key} has the value {value}; it must be finite")),
        None => Ok(()),
    }
}

impl Base {
    fn check(&self) -> Result<(), String> {
        match self {
            Self::Fixed { gravity_mps2, .. } => finite("base.gravity_mps2", gravity_mps2),
            Self::Stance { foot } if foot.is_empty() => Err(
                "base.foot is empty; add one [[base.foot]] for each link that may be at rest"
                    .into(),
            ),
            Self::Stance { foot } => foot.iter().try_for_each(|foot| {
                let key = format!("base.foot {:?}: gravity_mps2", foot.link);
                finite(&key, &foot.gravity_mps2)
            }),
            Self::Imu { xyz_m, rpy_rad, .. } => {
                finite("base.xyz_m", xyz_m)?;
                finite("base.rpy_rad", rpy_rad)
            }
        }
    }
}

impl ForceTorque {
    fn check(&self) -> Result<(), String> {
        let at = |key: &str| format!("force_torque {:?}: {key}", self.sensor);
        for (key, noise) in [("noise_n", self.noise_n), ("noise_nm", self.noise_nm)] {
            if let Some(value) = noise.into_iter().find(|v| !(*v > 0.0 && v.is_finite())) {
                return Err(format!(
                    "{} has the value {value}; a standard deviation must be above 0",
                    at(key)
                ));
            }
        }
        for (key, deviation) in [
            ("offset_std_n", self.offset_std_n),
            ("offset_std_nm", self.offset_std_nm),
        ] {
            let mut values = deviation.into_iter().flatten();
            if let Some(value) = values.find(|v| !(*v >= 0.0 && v.is_finite())) {
                return Err(format!(
                    "{} has the value {value}; a standard deviation cannot be negative",
                    at(key)
                ));
            }
        }
        if let Some(numbers) = &self.gain {
            finite(&at("gain"), numbers)?;
            if gain_from_force_first(numbers).is_none_or(|gain| !gain.is_invertible()) {
                return Err(format!(
                    "{} is singular: some wrenches would give no reading; check its numbers",
                    at("gain")
                ));
            }
        }
        let reference = self.reference_celsius;
        finite(&at("temperature_n_per_k"), &self.temperature_n_per_k)?;
        finite(&at("temperature_nm_per_k"), &self.temperature_nm_per_k)?;
        finite(&at("reference_celsius"), reference.as_slice())?;
        let drifts = [self.temperature_n_per_k, self.temperature_nm_per_k] != [[0.0; 3]; 2];
        if drifts && reference.is_none() {
            return Err(format!(
                "{} is missing: temperature_n_per_k and temperature_nm_per_k are relative to it",
                at("reference_celsius")
            ));
        }
        for (key, numbers) in [
            ("offset_n", self.offset_n),
            ("offset_nm", self.offset_nm),
            ("xyz_m", self.xyz_m),
            ("rpy_rad", self.rpy_rad),
        ] {
            finite(&at(key), &numbers.unwrap_or_default())?;
        }
        Ok(())
    }

    /// Its offset, and the standard deviations of it [torque; force] \[Nm, N\].
    #[must_use]
    pub fn offset(&self) -> (Wrench, [f64; 6]) {
        let with_std = |value: Option<[f64; 3]>, deviation: Option<[f64; 3]>, unknown: f64| {
            let exact = if value.is_some() { 0.0 } else { unknown };
            (value.unwrap_or_default(), deviation.unwrap_or([exact; 3]))
        };
        let [of_torque, of_force] = [UNKNOWN_OFFSET[0], UNKNOWN_OFFSET[3]];
        let (force, [fx, fy, fz]) = with_std(self.offset_n, self.offset_std_n, of_force);
        let (torque, [tx, ty, tz]) = with_std(self.offset_nm, self.offset_std_nm, of_torque);
        (Wrench::from_parts(force, torque), [tx, ty, tz, fx, fy, fz])
    }

    /// Its calibration.
    #[must_use]
    pub fn calibration(&self) -> Calibration {
        let gain = self.gain.as_deref().and_then(gain_from_force_first);
        Calibration::new(
            gain.unwrap_or_else(nalgebra::Matrix6::identity),
            Wrench::from_parts(self.temperature_n_per_k, self.temperature_nm_per_k),
            self.reference_celsius,
        )
    }
}

impl TactileSkin {
    fn check(&self) -> Result<(), String> {
        for (key, value, most) in [
            ("noise", self.noise, 1e6),
            ("false_alarms_per_hour", self.false_alarms_per_hour, 1e6),
            ("max_silence_ms", self.max_silence_ms, 3.6e6),
            ("position_std_m", self.position_std_m.unwrap_or(1.0), 1.0),
        ] {
            positive(&format!("skin {:?}: {key}", self.channel), value, most)?;
        }
        Ok(())
    }
}

impl ContactSite {
    fn check(&self) -> Result<(), String> {
        let at = |key: &str| format!("contact {:?}: {key}", self.name());
        finite(&at("position_m"), &self.position_m)?;
        let key = at("direction");
        match (self.kind, self.direction) {
            (ContactModel::ForceAlong, None) => {
                Err(format!("{key} is missing: kind = \"force_along\" needs it"))
            }
            (ContactModel::ForceAlong, Some(direction)) => {
                finite(&key, &direction)?;
                match direction == [0.0; 3] {
                    true => Err(format!("{key} must not be zero")),
                    false => Ok(()),
                }
            }
            (_, Some(_)) => Err(format!("{key} is allowed with kind = \"force_along\" only")),
            (_, None) => Ok(()),
        }
    }

    /// Its name if given, else that of its link.
    #[must_use]
    pub fn name(&self) -> &str {
        self.name.as_deref().unwrap_or(&self.link)
    }
}

/// The words of other crates' types, for the reference. Each list is complete, or does not compile.
#[cfg(test)]
#[allow(dead_code)] // only their description is used
mod elsewhere {
    use schemars::JsonSchema;
    use serde::Serialize;

    #[derive(JsonSchema, Serialize)]
    #[serde(remote = "super::MeasurementFrame", rename_all = "lowercase")]
    pub(super) enum FrameWord {
        /// The child link's.
        Child,
        /// The parent link's.
        Parent,
        /// The sensor's own, posed relative to the child link.
        Sensor,
    }

    #[derive(JsonSchema, Serialize)]
    #[serde(remote = "super::MeasurementDirection", rename_all = "snake_case")]
    pub(super) enum DirectionWord {
        /// By the child on the parent: reading = -(wrench by the parent on the child) + offset.
        ChildToParent,
        /// By the parent on the child: reading = wrench by the parent on the child + offset.
        ParentToChild,
    }

    #[derive(JsonSchema, Serialize)]
    #[serde(remote = "super::Gain", rename_all = "lowercase")]
    pub(super) enum GainWord {
        /// All 36 where there is a sensor: the prior keeps those that the logs do not determine.
        Auto,
        /// None: the factory gain is correct.
        None,
        /// One for each channel.
        Diagonal,
        /// All 36.
        Full,
    }

    #[derive(JsonSchema, Serialize)]
    #[serde(remote = "super::IdentificationInput", rename_all = "lowercase")]
    pub(super) enum InputWord {
        /// The force/torque sensors.
        Wrench,
        /// Measured joint torques.
        Torque,
    }

    #[derive(JsonSchema, Serialize)]
    #[serde(remote = "super::TorqueSide", rename_all = "lowercase")]
    pub(super) enum SideWord {
        /// Between gear and link, by a joint torque sensor. The rotor's inertia is not included.
        Link,
        /// At the motor: current times torque constant and gear ratio. The rotor's inertia is
        /// included and identified.
        Motor,
    }
}

#[cfg(test)]
mod tests;
