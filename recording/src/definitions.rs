//! The definitions of the messages, as ROS 2 writes them (`ros2msg`).

use proprio_topics::Kind;

/// The encoding of all definitions.
pub(crate) const SCHEMA: &str = "ros2msg";
/// The encoding of all messages.
pub(crate) const MESSAGE: &str = "cdr";

/// Name and definition of a message.
pub(crate) type Definition = (String, String);

/// A reading of this kind: its values are those of the tables, in their order.
pub(crate) fn sample(kind: Kind) -> Definition {
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
    (name, text)
}

pub(crate) fn declared() -> Definition {
    let text = "# A contact is declared present or absent from an instant on.\n\
                # CLOCK_MONOTONIC [ns]\n\
                int64 acquired\n\
                bool active\n\
                # Where it acts [m], its standard deviation, the direction of its force. NaN: as\n\
                # configured.\n\
                float64[3] position\n\
                float64 position_std\n\
                float64[3] direction\n";
    ("proprio_msgs/msg/Declared".into(), text.into())
}

pub(crate) fn torques() -> Definition {
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
    ("proprio_msgs/msg/Torques".into(), text.into())
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

pub(crate) fn joint_state() -> Definition {
    let text = format!(
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n\
         float64[] effort\n{HEADER}"
    );
    ("sensor_msgs/msg/JointState".into(), text)
}

pub(crate) fn wrench_stamped() -> Definition {
    let line = "=".repeat(80);
    let text = format!(
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n{HEADER}{line}\n\
         MSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\n\
         geometry_msgs/Vector3 torque\n{VECTOR}"
    );
    ("geometry_msgs/msg/WrenchStamped".into(), text)
}

pub(crate) fn imu() -> Definition {
    let line = "=".repeat(80);
    let text = format!(
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n\
         float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n\
         float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n\
         float64[9] linear_acceleration_covariance\n{HEADER}{VECTOR}{line}\n\
         MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    );
    ("sensor_msgs/msg/Imu".into(), text)
}
