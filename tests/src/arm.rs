//! Variants of `config/icub_left_arm` with other buses, periods and time-outs.

use proprio_simulator::SimulatedRobot;
use std::fs;
use std::path::Path;
use toml::{Table, Value};

/// The two configuration files of the arm, which can be changed and written.
#[derive(Debug, Clone)]
pub struct Arm {
    /// gateway.toml.
    pub gateway: Table,
    /// estimator.toml.
    pub estimator: Table,
}

impl Default for Arm {
    fn default() -> Self {
        Self::new()
    }
}

impl Arm {
    /// The configuration as it is in the repository.
    ///
    /// # Panics
    /// If it cannot be read.
    #[must_use]
    pub fn new() -> Self {
        let folder = SimulatedRobot::find("icub_left_arm").expect("the robot of this repository");
        let read = |name: &str| -> Table {
            fs::read_to_string(folder.join(name))
                .expect(name)
                .parse()
                .expect("it is TOML")
        };
        let (gateway, mut estimator) = (read("gateway.toml"), read("estimator.toml"));
        let model = folder
            .join("model.urdf")
            .canonicalize()
            .expect("the robot's model");
        estimator.insert(
            "model".into(),
            model.to_str().expect("a path in UTF-8").into(),
        );
        Self { gateway, estimator }
    }

    /// Periods for a single slow processor: F/T every 10 ms, joints and IMU every 20 ms, with
    /// suitable time-outs.
    #[must_use]
    pub fn slow() -> Self {
        let paced = Self::new().periods(10, 20, 20).patience(1000.0, 100.0);
        // The halves of a wrench may arrive far apart, too, if everything shares one processor.
        paced.each_device(|driver, device| {
            if driver == "icub_strain" {
                device.insert("pair_timeout_ms".into(), 500.0.into());
            }
        })
    }

    /// Sets the periods of the F/T sensor, the IMU and the motor boards \[ms\].
    #[must_use]
    pub fn periods(self, force_torque: i64, imu: i64, motors: i64) -> Self {
        self.each_device(|driver, device| {
            let period = match driver {
                "icub_strain" => force_torque,
                "icub_imu" => imu,
                _ => motors,
            };
            device.insert("period_ms".into(), period.into());
        })
    }

    /// Sets the maximum silence of devices and channels, and the wait of an estimate \[ms\].
    #[must_use]
    pub fn patience(self, max_silence_ms: f64, max_wait_ms: f64) -> Self {
        let mut this = self.each_device(|_, device| {
            device.insert("max_silence_ms".into(), max_silence_ms.into());
        });
        this.set("input", "max_silence_ms", max_silence_ms);
        this.aligned(max_wait_ms)
    }

    /// Makes each estimate wait for the samples of other channels, at most so long \[ms\].
    #[must_use]
    pub fn aligned(mut self, max_wait_ms: f64) -> Self {
        self.set("output", "max_wait_ms", max_wait_ms);
        self
    }

    /// Sets the peak error of joint positions that the estimator assumes \[rad\].
    #[must_use]
    pub fn position_noise(mut self, rad: f64) -> Self {
        self.set("differentiation", "position_noise_rad", rad);
        self
    }

    fn set(&mut self, table: &str, key: &str, value: f64) {
        let table = self
            .estimator
            .entry(table)
            .or_insert_with(|| Table::new().into());
        table
            .as_table_mut()
            .expect("a table")
            .insert(key.into(), value.into());
    }

    /// Sets CAN interfaces as the buses' sources.
    #[must_use]
    pub fn on_interfaces(self, interfaces: [&str; 2]) -> Self {
        self.on("socketcan", "interface", interfaces)
    }

    /// Sets virtual buses of these names as the buses' sources.
    #[must_use]
    pub fn on_virtual(self, names: [&str; 2]) -> Self {
        self.on("virtual", "name", names)
    }

    fn on(mut self, kind: &str, key: &str, names: [&str; 2]) -> Self {
        for (bus, name) in self.buses().zip(names) {
            let source = Table::from_iter([
                ("kind".to_owned(), kind.into()),
                (key.to_owned(), name.into()),
            ]);
            bus.insert("source".into(), source.into());
        }
        self
    }

    /// Applies a change to every device; the closure also gets the driver's name.
    #[must_use]
    pub fn each_device(mut self, mut change: impl FnMut(&str, &mut Table)) -> Self {
        for bus in self.buses() {
            for device in bus
                .get_mut("device")
                .and_then(Value::as_array_mut)
                .into_iter()
                .flatten()
            {
                let device = device.as_table_mut().expect("a device is a table");
                let driver = device
                    .get("driver")
                    .and_then(Value::as_str)
                    .expect("a device has a driver")
                    .to_owned();
                change(&driver, device);
            }
        }
        self
    }

    fn buses(&mut self) -> impl Iterator<Item = &mut Table> {
        let buses = self.gateway.get_mut("bus").and_then(Value::as_array_mut);
        buses.into_iter().flatten().filter_map(Value::as_table_mut)
    }

    /// Writes both files into `folder` and loads them.
    ///
    /// # Panics
    /// If they cannot be written or are not valid configurations.
    #[must_use]
    pub fn write(&self, folder: &Path) -> Written {
        fs::create_dir_all(folder).expect("a folder for the configuration");
        for (name, table) in [
            ("gateway.toml", &self.gateway),
            ("estimator.toml", &self.estimator),
        ] {
            fs::write(folder.join(name), table.to_string())
                .expect("a configuration can be written");
        }
        let text = |name: &str| {
            folder
                .join(name)
                .to_str()
                .expect("a path in UTF-8")
                .to_owned()
        };
        Written {
            robot: SimulatedRobot::load(folder).unwrap_or_else(|error| panic!("{error}")),
            folder: text(""),
            gateway: text("gateway.toml"),
            estimator: text("estimator.toml"),
        }
    }
}

/// A configuration on disk.
#[derive(Debug, Clone)]
pub struct Written {
    /// The loaded robot.
    pub robot: SimulatedRobot,
    /// The path of its folder.
    pub folder: String,
    /// The path of gateway.toml.
    pub gateway: String,
    /// The path of estimator.toml.
    pub estimator: String,
}
