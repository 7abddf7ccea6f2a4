//! The definitions of the messages, as ROS 2 writes them (`ros2msg`): texts and encodings that
//! recordings and viewers hold beside the messages.

use proprio_topics::Kind;

/// The encoding of all definitions.
pub const SCHEMA: &str = "ros2msg";
/// The encoding of all messages.
pub const MESSAGE: &str = "cdr";

/// The definition of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Definition {
    /// Its name, as `sensor_msgs/msg/Imu`.
    pub name: String,
    /// Its fields, with the definitions of the messages in it.
    pub text: String,
}

impl Definition {
    fn new(name: &str, text: impl Into<String>) -> Self {
        let (name, text) = (name.to_owned(), text.into());
        Self { name, text }
    }
}

/// A reading of this kind: its values are those of the tables, in their order.
#[must_use]
pub fn sample(kind: Kind) -> Definition {
    let word = kind.word();
    let mut name = String::from("proprio_msgs/msg/");
    name.extend(word.chars().take(1).map(|c| c.to_ascii_uppercase()));
    name.extend(word.chars().skip(1));
    let mut text = String::from(
        "# One reading of a channel. SI units, the sensor's own axes; NaN: not reported.\n\
         # CLOCK_MONOTONIC [ns] at which its first CAN frame was received.\n\
         int64 acquired\n\
         # Bits: 1 gap before, 2 saturated, 4 frozen, 8 device fault, 16 not calibrated,\n\
         # 32 device counter, 64 drive fault, 128 zero changed, 256 implausible; from bit 16 on:\n\
         # which axes saturate.\n\
         uint32 quality\n",
    );
    for field in kind.fields() {
        text.push_str(&format!("float64 {field}\n"));
    }
    Definition { name, text }
}

/// A contact is declared.
#[must_use]
pub fn declared() -> Definition {
    let text = "# A contact is declared present or absent from an instant on.\n\
                # CLOCK_MONOTONIC [ns]\n\
                int64 acquired\n\
                bool active\n\
                # Where it acts [m], its standard deviation, the direction of its force. NaN: as\n\
                # configured.\n\
                float64[3] position\n\
                float64 position_std\n\
                float64[3] direction\n";
    Definition::new("proprio_msgs/msg/Declared", text)
}

/// Torques with deviations and reasons.
#[must_use]
pub fn torques() -> Definition {
    let text = "# The torques of all joints at one instant, by the parent link on the child link\n\
                # along the URDF axis [Nm] (forces [N] for prismatic joints).\n\
                # CLOCK_MONOTONIC [ns]\n\
                int64 acquired\n\
                string[] joint\n\
                # NaN: withheld\n\
                float64[] torque\n\
                float64[] standard_deviation\n\
                bool[] valid\n\
                # Why it is withheld; empty: it is not.\n\
                string[] reason\n\
                # The channel that causes it; empty: no single one.\n\
                string[] cause\n";
    Definition::new("proprio_msgs/msg/Torques", text)
}

/// The torques of drives, and whether they agree.
#[must_use]
pub fn drives() -> Definition {
    let text = "# What the joints' drives report, less friction and rotor [Nm, N], beside the\n\
                # torques from the force/torque sensors.\n\
                # CLOCK_MONOTONIC [ns]\n\
                int64 acquired\n\
                string[] joint\n\
                # NaN: it reports nothing\n\
                float64[] torque\n\
                float64[] standard_deviation\n\
                # unknown, agrees or disagrees\n\
                string[] agreement\n\
                # The smoothed difference, in deviations of both together.\n\
                float64[] deviate\n\
                # If it disagrees: the first joint of its sub-tree that does.\n\
                string[] group\n\
                # What may have caused the disagreements of a group: contact, sensor or drive.\n\
                string[] candidate\n\
                string[] candidate_name\n\
                string[] candidate_group\n";
    Definition::new("proprio_msgs/msg/Drives", text)
}

/// The torque of one joint, with a band for plots.
#[must_use]
pub fn joint_torque() -> Definition {
    let text = "# The torque of a joint, as in Torques, with a band of two standard deviations:\n\
                # about 95 % of the errors are smaller.\n\
                # CLOCK_MONOTONIC [ns]\n\
                int64 acquired\n\
                # NaN: withheld\n\
                float64 torque\n\
                float64 lower\n\
                float64 upper\n\
                bool valid\n\
                # Why it is withheld; empty: it is not.\n\
                string reason\n\
                # The channel that causes it; empty: no single one.\n\
                string cause\n";
    Definition::new("proprio_msgs/msg/JointTorque", text)
}

/// Contact wrenches with deviations and reasons.
#[must_use]
pub fn contacts() -> Definition {
    let line = "=".repeat(80);
    let text = format!(
        "# The wrenches of all contacts at one instant, by the surroundings on the robot.\n\
         # CLOCK_MONOTONIC [ns]\n\
         int64 acquired\n\
         Contact[] contacts\n\
         {line}\n\
         MSG: proprio_msgs/Contact\n\
         string name\n\
         # The frame of axes and point.\n\
         string frame\n\
         # NaN: withheld [N, Nm]\n\
         float64[3] force\n\
         float64[3] torque\n\
         # Of force, then of torque.\n\
         float64[6] standard_deviation\n\
         bool valid\n\
         # Why it is withheld; empty: it is not.\n\
         string reason\n\
         # The channel that causes it; empty: no single one.\n\
         string cause\n\
         # Found by the estimator, not declared.\n\
         bool detected\n\
         # Where the force acts [m], if it is located.\n\
         bool located\n\
         float64[3] position\n"
    );
    Definition::new("proprio_msgs/msg/Contacts", text)
}

/// `diagnostic_msgs/DiagnosticArray`.
#[must_use]
pub fn diagnostics() -> Definition {
    let line = "=".repeat(80);
    let text = format!(
        "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n{HEADER}{line}\n\
         MSG: diagnostic_msgs/DiagnosticStatus\nbyte OK=0\nbyte WARN=1\nbyte ERROR=2\n\
         byte STALE=3\nbyte level\nstring name\nstring message\nstring hardware_id\n\
         diagnostic_msgs/KeyValue[] values\n{line}\n\
         MSG: diagnostic_msgs/KeyValue\nstring key\nstring value\n"
    );
    Definition::new("diagnostic_msgs/msg/DiagnosticArray", text)
}

/// `can_msgs/Frame`: a classic frame, of ros_canopen.
#[must_use]
pub fn classic_frame() -> Definition {
    let text = format!(
        "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\n\
         uint8 dlc\nuint8[8] data\n{HEADER}"
    );
    Definition::new("can_msgs/msg/Frame", text)
}

/// `ros2_socketcan_msgs/FdFrame`: a CAN FD frame.
#[must_use]
pub fn fd_frame() -> Definition {
    let text = format!(
        "std_msgs/Header header\nuint32 id\nbool is_extended\nbool is_error\nuint8 len\n\
         uint8[<=64] data\n{HEADER}"
    );
    Definition::new("ros2_socketcan_msgs/msg/FdFrame", text)
}

const HEADER: &str = "\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";
const VECTOR: &str = "\
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
";
const QUATERNION: &str = "\
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
";

/// `sensor_msgs/JointState`.
#[must_use]
pub fn joint_state() -> Definition {
    let text = format!(
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n\
         float64[] effort\n{HEADER}"
    );
    Definition::new("sensor_msgs/msg/JointState", text)
}

/// `geometry_msgs/WrenchStamped`.
#[must_use]
pub fn wrench_stamped() -> Definition {
    let line = "=".repeat(80);
    let text = format!(
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n{HEADER}{line}\n\
         MSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\n\
         geometry_msgs/Vector3 torque\n{VECTOR}"
    );
    Definition::new("geometry_msgs/msg/WrenchStamped", text)
}

/// `std_msgs/String`.
#[must_use]
pub fn string() -> Definition {
    Definition::new("std_msgs/msg/String", "string data\n")
}

/// `tf2_msgs/TFMessage`.
#[must_use]
pub fn transforms() -> Definition {
    let line = "=".repeat(80);
    let text = format!(
        "geometry_msgs/TransformStamped[] transforms\n{line}\n\
         MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n\
         geometry_msgs/Transform transform\n{HEADER}{line}\n\
         MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\n\
         geometry_msgs/Quaternion rotation\n{VECTOR}{QUATERNION}"
    );
    Definition::new("tf2_msgs/msg/TFMessage", text)
}

/// `sensor_msgs/Imu`.
#[must_use]
pub fn imu() -> Definition {
    let text = format!(
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n\
         float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n\
         float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n\
         float64[9] linear_acceleration_covariance\n{HEADER}{VECTOR}{QUATERNION}"
    );
    Definition::new("sensor_msgs/msg/Imu", text)
}
