//! What the simulated robot does.

use crate::fault::InjectedFault;

/// What the simulated robot does.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulationSettings {
    /// The seed of motion, noise and faults.
    pub seed: u64,
    /// Duration without motion at the start \[s\].
    pub still: f64,
    /// Whether its hand is pushed, from 40 % to 60 % of every cycle.
    pub push: bool,
    /// Duration of a cycle \[s\].
    pub cycle: f64,
    /// Whether sensors have noise. Without noise only the boards' quantisation remains.
    pub noise: bool,
    /// The faults.
    pub faults: Vec<InjectedFault>,
}

impl Default for SimulationSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            still: 1.0,
            push: true,
            cycle: 20.0,
            noise: true,
            faults: Vec::new(),
        }
    }
}
