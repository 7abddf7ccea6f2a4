//! Times dynibo. Usage: peers-dynibo folded.urdf states.txt        (protocol: ../../server.rs)

#[path = "../../server.rs"]
#[allow(dead_code, reason = "each program uses its own part")]
mod server;

use std::rc::Rc;

use dynibo::{BaseState, FloatingRobot, Frame, Robot, Twist};
use server::{Bench, Output, States, fail};

/// Inverse dynamics, the base standing still.
struct Fixed {
    robot: Robot,
    states: Rc<States>,
    torque: Vec<f64>,
}

impl Bench for Fixed {
    fn run(&mut self, state: usize) {
        let s = &self.states.states[state];
        self.robot
            .inverse_dynamics(
                &s.position,
                &s.velocity,
                &s.acceleration,
                &[],
                &mut self.torque,
            )
            .unwrap_or_else(|error| fail(&error.to_string()));
    }

    fn show(&self, output: &mut Output) {
        for (name, torque) in self.states.joints.iter().zip(&self.torque) {
            output.add("torque", name, *torque);
        }
    }
}

/// Inverse dynamics, the base moving.
struct Floating {
    robot: FloatingRobot,
    states: Rc<States>,
    bases: Vec<BaseState>,
    /// Torque and force at the base in the world's axes, then the joints.
    generalized: Vec<f64>,
}

impl Bench for Floating {
    fn run(&mut self, state: usize) {
        let s = &self.states.states[state];
        self.robot
            .inverse_dynamics(
                &self.bases[state],
                &s.position,
                &s.velocity,
                &s.acceleration,
                &[],
                &mut self.generalized,
            )
            .unwrap_or_else(|error| fail(&error.to_string()));
    }

    fn show(&self, output: &mut Output) {
        output.add3("moment", "base", self.generalized[..3].iter().copied());
        output.add3("force", "base", self.generalized[3..6].iter().copied());
        for (name, torque) in self.states.joints.iter().zip(&self.generalized[6..]) {
            output.add("torque", name, *torque);
        }
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [urdf, states] = &arguments[..] else {
        fail("usage: peers-dynibo folded.urdf states.txt");
    };
    let robot = Robot::from_urdf(urdf).unwrap_or_else(|error| fail(&format!("{urdf}: {error}")));
    let floating =
        FloatingRobot::from_urdf(urdf).unwrap_or_else(|error| fail(&format!("{urdf}: {error}")));
    let names: Vec<&str> = (0..robot.joint_count())
        .filter_map(|dof| robot.joint_name(dof).ok())
        .collect();
    let states = Rc::new(States::read(states).in_order_of(&names));
    let twist = |angular: [f64; 3], linear: [f64; 3]| {
        let mut twist = Twist::zeros();
        twist.angular.copy_from_slice(&angular);
        twist.linear.copy_from_slice(&linear);
        twist
    };
    let bases = states
        .states
        .iter()
        .map(|state| {
            let base = &state.base;
            BaseState::new(
                Frame::identity(),
                twist(base.angular_velocity, base.velocity),
                twist(base.angular_acceleration, base.acceleration),
            )
            .unwrap_or_else(|error| fail(&error.to_string()))
        })
        .collect();
    let count = states.states.len();
    server::serve(
        count,
        &mut [
            (
                "rnea",
                Box::new(Fixed {
                    torque: vec![0.0; robot.generalized_count()],
                    robot,
                    states: Rc::clone(&states),
                }),
            ),
            (
                "rnea_floating",
                Box::new(Floating {
                    generalized: vec![0.0; floating.generalized_count()],
                    robot: floating,
                    states,
                    bases,
                }),
            ),
        ],
    );
}
