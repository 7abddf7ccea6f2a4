//! A robot, loaded from its configuration folder: gateway.toml, estimator.toml and the URDF that
//! the latter names.

use proprio_dynamics::model::{Frame, Model, ModelError};
use proprio_estimator::config::Config;
use proprio_gateway::plan::Plan;
use std::path::{Path, PathBuf};

/// One robot: the configuration of simulator, gateway and estimator.
#[derive(Debug, Clone)]
pub struct SimulatedRobot {
    /// The folder that it was loaded from.
    pub folder: PathBuf,
    /// Its buses and boards: gateway.toml, checked.
    pub plan: Plan,
    /// Its sensors, contacts and base: estimator.toml.
    pub config: Config,
    /// Its bodies and joints; the joints that carry F/T sensors are kept.
    pub model: Model,
}

/// Why a robot cannot be loaded: a wrong name or a wrong configuration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulatedRobotError {
    /// There is no folder of that name.
    #[error(
        "there is no robot {name:?} (no gateway.toml in {}); give the name of a folder \
         there, or a path to one",
        .tried.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ")
    )]
    NotFound {
        /// The name requested.
        name: String,
        /// The folders searched.
        tried: Vec<PathBuf>,
    },
    /// gateway.toml is wrong.
    #[error(transparent)]
    Gateway(#[from] proprio_gateway::plan::PlanError),
    /// estimator.toml is wrong.
    #[error(transparent)]
    Estimator(#[from] proprio_estimator::config::InvalidConfig),
    /// The URDF is wrong.
    #[error("{}: {cause}", .file.display())]
    Model {
        /// The file.
        file: PathBuf,
        /// The error.
        cause: Box<ModelError>,
    },
    /// The files do not match each other.
    #[error("{}: {problem}", .folder.display())]
    Mismatch {
        /// Their folder.
        folder: PathBuf,
        /// The contradiction.
        problem: String,
    },
}

impl SimulatedRobot {
    /// The folders to search for robot `name`, in order: `name` itself as a path; `config/NAME` in
    /// the working directory, in the executable's folder and its parents, and in the source tree of
    /// this build; `/usr/share/proprio/config/NAME`; `/etc/proprio/NAME`.
    #[must_use]
    pub fn candidates(name: &str) -> Vec<PathBuf> {
        let mut folders = vec![PathBuf::from(name)];
        // A name with a slash is a path.
        if name.contains('/') || name.is_empty() || name == ".." || name == "." {
            return folders;
        }
        let below = |root: &Path| root.join("config").join(name);
        folders.push(below(Path::new(".")));
        if let Ok(executable) = std::env::current_exe() {
            // For an executable in target/release, the source tree's config is in a parent folder.
            folders.extend(executable.ancestors().skip(1).take(4).map(below));
        }
        if let Some(tree) = Path::new(env!("CARGO_MANIFEST_DIR")).parent() {
            folders.push(below(tree));
        }
        folders.push(below(Path::new("/usr/share/proprio")));
        folders.push(Path::new("/etc/proprio").join(name));
        let mut seen = Vec::new();
        folders.retain(|folder| {
            let new = !seen.contains(folder);
            seen.push(folder.clone());
            new
        });
        folders
    }

    /// Finds the folder of a robot by its name or path.
    ///
    /// # Errors
    /// [`SimulatedRobotError::NotFound`], with all folders searched.
    pub fn find(name: &str) -> Result<PathBuf, SimulatedRobotError> {
        let tried = Self::candidates(name);
        match tried
            .iter()
            .find(|folder| folder.join("gateway.toml").is_file())
        {
            Some(folder) => Ok(folder.clone()),
            None => Err(SimulatedRobotError::NotFound {
                name: name.to_owned(),
                tried,
            }),
        }
    }

    /// Finds and loads a robot by name or path.
    ///
    /// # Errors
    /// [`SimulatedRobotError`].
    pub fn open(name: &str) -> Result<Self, SimulatedRobotError> {
        Self::load(&Self::find(name)?)
    }

    /// Loads the robot in `folder`.
    ///
    /// # Errors
    /// [`SimulatedRobotError`]: an unusable file, or files that do not match each other.
    pub fn load(folder: &Path) -> Result<Self, SimulatedRobotError> {
        let plan = Plan::load(&folder.join("gateway.toml"))?;
        let config = Config::load(&folder.join("estimator.toml"))?;
        let keep: Vec<&str> = config
            .force_torque
            .iter()
            .map(|ft| ft.joint.as_str())
            .collect();
        let mut model =
            Model::from_file(&config.model, &keep).map_err(|cause| SimulatedRobotError::Model {
                file: config.model.clone(),
                cause: Box::new(cause),
            })?;
        proprio_estimator::setup::hold(&config, &mut model);
        if plan.robot != config.robot {
            let problem = format!(
                "gateway.toml has robot = {:?}, estimator.toml robot = {:?}: they would not find \
                 each other",
                plan.robot, config.robot
            );
            return Err(SimulatedRobotError::Mismatch {
                folder: folder.to_owned(),
                problem,
            });
        }
        Ok(Self {
            folder: folder.to_owned(),
            plan,
            config,
            model,
        })
    }

    /// The error for a contradiction between the files of this robot.
    pub(crate) fn mismatch(&self, problem: String) -> SimulatedRobotError {
        SimulatedRobotError::Mismatch {
            folder: self.folder.clone(),
            problem,
        }
    }

    /// The error that something in estimator.toml is wrong.
    pub(crate) fn wrong_config(&self, problem: String) -> SimulatedRobotError {
        self.mismatch(format!("estimator.toml, {problem}"))
    }

    /// The frame of a link that estimator.toml names at `place`.
    pub(crate) fn frame(&self, place: &str, link: &str) -> Result<Frame, SimulatedRobotError> {
        let missing = || format!("{place}: link = {link:?} is not a link of the URDF");
        let frame = self.model.frame(link);
        frame.ok_or_else(|| self.wrong_config(missing()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_robot_of_the_source_tree_is_found_from_anywhere() {
        let robot = SimulatedRobot::open("icub_left_arm").unwrap();
        assert_eq!(robot.plan.robot, "icub_left_arm");
        assert_eq!(robot.model.dof_count(), 7);
        assert!(
            robot.model.joint("l_arm_ft_sensor").is_some(),
            "the F/T joint is kept"
        );
        let by_path = SimulatedRobot::open(robot.folder.to_str().unwrap()).unwrap();
        assert_eq!(by_path.plan.channels, robot.plan.channels);
    }

    #[test]
    fn a_robot_that_is_not_there_is_told_with_all_that_was_tried() {
        let message = SimulatedRobot::open("no_such_robot")
            .unwrap_err()
            .to_string();
        for place in [
            "\"no_such_robot\"",
            "./config/no_such_robot",
            "/etc/proprio/no_such_robot",
            "/usr/share/proprio/config/",
        ] {
            assert!(message.contains(place), "{place}: {message}");
        }
        // A path is not searched for elsewhere.
        assert_eq!(
            SimulatedRobot::candidates("some/where"),
            [PathBuf::from("some/where")]
        );
    }

    #[test]
    fn files_that_do_not_fit_each_other_are_refused() {
        let source = SimulatedRobot::find("icub_left_arm").unwrap();
        let folder = tempfile::tempdir().unwrap();
        for file in ["gateway.toml", "estimator.toml", "model.urdf"] {
            std::fs::copy(source.join(file), folder.path().join(file)).unwrap();
        }
        let file = folder.path().join("estimator.toml");
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(
            &file,
            text.replace("robot = \"icub_left_arm\"", "robot = \"other\""),
        )
        .unwrap();
        let message = SimulatedRobot::load(folder.path()).unwrap_err().to_string();
        assert!(message.contains("robot = \"other\""), "{message}");
        std::fs::write(folder.path().join("model.urdf"), "<robot").unwrap();
        std::fs::write(&file, text).unwrap();
        let message = SimulatedRobot::load(folder.path()).unwrap_err().to_string();
        assert!(message.contains("model.urdf"), "{message}");
    }
}
