//! What the plan says of joints: mistakes in the configuration, and where outputs lead.

use super::{ELBOW, SHOULDER, plan};

#[test]
fn each_mistake_has_one_clear_message() {
    let text = format!("{ELBOW}{SHOULDER}");
    let problem = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        plan(&text.replacen(from, to, 1))
            .map(|p| p.to_string())
            .unwrap_err()
    };
    for (from, to, expected) in [
        // Couplings.
        (
            "[0.0, -0.615, 0.615]",
            "[0.0, -0.615]",
            "bus \"arm\", coupling of \"pitch\", \"roll\", \"yaw\": matrix must have 3 rows of 3 \
             numbers: a row for each joint",
        ),
        (
            "-0.615, 0.615]",
            "-0.615, nan]",
            "matrix must hold finite numbers",
        ),
        ("-0.615, 0.615]", "-0.615, 0.0]", "matrix is singular"),
        (
            "-0.615, 0.615]",
            "-0.615, 0.0001]",
            "matrix is nearly singular: its condition number is",
        ),
        (
            "motors = [\"motor_1\", ",
            "motors = [",
            "there are 3 joints and 2 motors; it must be as many of both, 1 to 8",
        ),
        (
            "\"motor_2\", \"motor_3\"]",
            "\"motor_2\", \"motor_4\"]",
            "motor \"motor_4\" is no [[bus.device.joint]] of this bus; all motors of a coupling \
             must be on one bus, because each bus has a thread of its own; did you mean \"motor_",
        ),
        (
            "\"motor_2\", \"motor_3\"]",
            "\"motor_2\", \"motor_2\"]",
            "\"motor_2\" is in a coupling",
        ),
        (
            "\"roll\", \"yaw\"]",
            "\"roll\", \"roll\"]",
            "\"roll\" is in a coupling already",
        ),
        (
            "\"roll\", \"yaw\"]",
            "\"roll\", \"motor_1\"]",
            "\"motor_1\" is a joint and a motor",
        ),
        (
            "\"roll\", \"yaw\"]",
            "\"roll\", \"elbow\"]",
            "joint \"elbow\": its position comes from device \"encoder\" and from its coupling; \
             give them different names or",
        ),
        ("\"roll\", \"yaw\"]", "\"roll\", \"\"]", "must have 1 to"),
        (
            "matrix = ",
            "matirx = ",
            "unknown field `matirx`, expected one of `joints`, `motors`",
        ),
        (
            "[[bus.coupling]]",
            "[[bus.coupling]]\ntakes = [\"torque\"]",
            "joint \"pitch\": no device gives its position (only its coupling)",
        ),
        // Several devices.
        (
            "takes = [\"velocity\", \"torque\", \"current\"]",
            "",
            "joint \"elbow\": its position comes from device \"encoder\" and from device \
             \"drive\"; give them different names or, if both measure this joint, say with takes = \
             [...] what each of them gives: \"position\", \
             \"velocity\", \"acceleration\", \"torque\", \"current\"",
        ),
        (
            "takes = [\"velocity\", \"torque\", \"current\"]",
            "takes = [\"speed\"]",
            "unknown variant `speed`, expected one of `position`, `velocity`",
        ),
        (
            "takes = [\"velocity\", \"torque\", \"current\"]",
            "takes = []",
            "takes is empty",
        ),
        (
            "takes = [\"position\"]\n        wraps_rad = [0.0, 6.283185307179586]\n        \
             centre_rad = 0.5\n        max_speed_radps = 10.0",
            "takes = [\"acceleration\"]",
            "joint \"elbow\": no device gives its position (only device \"encoder\", device \
             \"drive\")",
        ),
        (
            "takes = [\"position\"]",
            "takes = [\"current\"]",
            "wraps_rad is given, but takes has no",
        ),
        ("takes = ", "take = ", "unknown field `take`"),
        ("takes = ", "take = ", "did you mean \"takes\"?"),
        // Turns.
        (
            "centre_rad = 0.5",
            "",
            "centre_rad is missing; wraps_rad, centre_rad and max_speed_radps",
        ),
        (
            "wraps_rad = [0.0, 6.283185307179586]",
            "",
            "\"encoder\", joint \"elbow\": wraps_rad is missing",
        ),
        (
            "6.283185307179586]",
            "-1.0]",
            "wraps_rad = [0, -1] must be the lower and the upper end",
        ),
        (
            "6.283185307179586]",
            "6.2832]",
            "wraps_rad = [0, 6.2832] looks like one turn of the device, rounded: the error would \
             grow with each turn; write [0, 6.283185307179586]",
        ),
        (
            "[0.0, 6.283185307179586]",
            "[0.0, 25735.9]",
            "looks like 4096 turns of the device",
        ),
        (
            "centre_rad = 0.5",
            "centre_rad = 90.0",
            "centre_rad = 90 looks like degrees",
        ),
        (
            "max_speed_radps = 10.0",
            "max_speed_radps = 0.0",
            "max_speed_radps = 0 must be above 0",
        ),
        (
            "max_speed_radps = 10.0",
            "max_speed_radps = 400.0",
            "\"encoder\": at max_speed_radps its shaft turns by half the range of wraps_rad in \
             0.007853982 s, and it sends only every 0.01 s: the turns cannot be counted",
        ),
    ] {
        let problem = problem(from, to);
        assert!(problem.contains(expected), "{from} -> {to}: {problem}");
    }
    // A range that is no number of turns is legal.
    let odd = text.replace("[0.0, 6.283185307179586]", "[-12.5, 12.5]");
    assert!(plan(&odd).is_ok(), "{:?}", plan(&odd));
    // Devices of one joint on two buses.
    let bus = "[[bus]]\nname = \"other\"\nsource = { kind = \"virtual\", name = \"other\" }\n";
    let drive = ELBOW
        .find("[[bus.device]]\n      driver = \"canopen_drive\"")
        .unwrap();
    let split = format!("{}{bus}{}", &ELBOW[..drive], &ELBOW[drive..]);
    let problem = plan(&split).unwrap_err();
    let expected = "\"elbow\" is on bus \"arm\" too; devices that measure one joint must be on one \
                    bus, because each bus has a thread of its own";
    assert!(problem.contains(expected), "{problem}");
}

#[test]
fn the_plan_shows_where_each_output_leads() {
    let shown = plan(&format!("{ELBOW}{SHOULDER}")).unwrap().to_string();
    for line in [
        "    channel   0 joint elbow = -1 * output 0 of the device +0.2 rad (position alone), \
         turns counted, certain over 0.314159265 s, else right from -2.6416 to 3.6416 rad, stale \
         after 0.04 s\n",
        "    channel   0 joint elbow = 0.01 * output 0 of the device +0 rad (velocity, torque, \
         current alone), stale after",
        "    channel   2 joint roll, by the coupling; motor motor_2 = -0.01 * output 0 of the \
         device +0.5 rad, stale after 0.05 s\n",
        "  coupling, condition number 7.9\n    pitch = 1 * motor_1\n    roll = 1 * motor_1 + 0.615 \
         * motor_2\n    yaw = -0.615 * motor_2 + 0.615 * motor_3\n",
    ] {
        assert!(shown.contains(line), "{line}\n{shown}");
    }
}
