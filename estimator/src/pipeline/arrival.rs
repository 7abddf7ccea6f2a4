//! The pipeline's input: samples, of skins too, and declarations of contacts.

use super::Pipeline;
use super::buffers::{ChannelBuffer, Sanity};
use super::prediction::Predictor;
use crate::differentiate::Window;
use crate::history::History;
use crate::skin::Taken;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{self as topics, ContactState, Nanos, Quality, Reading, Reason};

impl Pipeline {
    /// Takes a sample of channel number `channel`, acquired at `t`. A temperature of an F/T
    /// sensor's board is also taken, if the sensor's calibration depends on it and the board
    /// reports no fault. Other readings of a kind that the channel does not use are ignored. Call
    /// [`Pipeline::poll`] until it gives nothing before the next sample.
    pub fn push(&mut self, channel: usize, t: Nanos, reading: &Reading, quality: Quality) {
        let Some(buffer) = self.buffers.get_mut(channel) else {
            return self.push_skin(channel, t, reading, quality);
        };
        let role = self.setup.robot.channels.get(channel).map(|c| c.role);
        if let (Reading::Joint(j), Some(ChannelRole::Joint(dof))) = (reading, role)
            && let Some(drives) = &mut self.drives
        {
            drives.push(dof, t, [j.torque, j.current], quality);
        }
        // Estimates that do not wait go by the order of arrival: no sample is late.
        let waits = self.setup.waits;
        let newest = buffer.newest().unwrap_or(Nanos::MIN);
        let arrival = Arrival {
            t,
            quality,
            newest,
            released: waits.then_some(self.released),
            max_silence: self.setup.robot.max_silence,
            sanity: self.sanity.get_mut(channel),
        };
        let fate = match (buffer, reading) {
            // For example a row with a torque alone: nothing to differentiate.
            (ChannelBuffer::Joint(..), Reading::Joint(j)) if j.position.is_nan() => return,
            (ChannelBuffer::Joint(history, window), Reading::Joint(j)) => {
                arrival.joint(history, window, j)
            }
            (ChannelBuffer::Sensor(..), Reading::Temperature(temperature)) => {
                return self.push_temperature(channel, t, temperature.celsius, quality);
            }
            (ChannelBuffer::Sensor(history, _, predictor), Reading::Wrench(w)) => {
                let fate = arrival.wrench(history, predictor, w);
                // The first reading is of the zero that the configuration is of. A reading that is
                // of no use tells of a new zero all the same.
                if quality.intersects(Quality::ZERO_CHANGED)
                    && newest > Nanos::MIN
                    && let Some(ChannelRole::Sensor(number)) = role
                    && let Some(since) = self.new_zeros.get_mut(number)
                {
                    since.get_or_insert(newest);
                    if let Some(identification) = &mut self.identification {
                        identification.begin_zero(number, t);
                    }
                }
                fate
            }
            (ChannelBuffer::Imu(history, window, predictor), Reading::Imu(i)) => {
                arrival.imu(history, (window, predictor), i)
            }
            _ => return,
        };
        match fate {
            Fate::Taken => {}
            Fate::NotFinite => return self.counts.not_finite += 1,
            Fate::Late => return self.counts.late += 1,
            Fate::Backward => return self.counts.backward += 1,
        }
        self.counts.taken += 1;
        // Taken, but too late for a released instant: a replay would use it there.
        let until = self
            .released
            .saturating_add(Nanos(self.setup.max_wait.0 / 2));
        self.counts.late +=
            u64::from(waits && newest > Nanos::MIN && newest < self.released && t <= until);
        self.newest = self.newest.max(t);
        if channel == self.setup.robot.trigger {
            if self.waiting.len() < Self::MAX_WAITING {
                self.waiting.push_back(t);
            } else {
                self.counts.late += 1;
            }
        }
    }

    /// Takes the temperature of an F/T sensor's board, if the sensor's calibration depends on it.
    fn push_temperature(&mut self, channel: usize, t: Nanos, celsius: f64, quality: Quality) {
        if !self.setup.depends_on_temperature(channel) || quality.intersects(Quality::DEVICE_FAULT)
        {
            return;
        }
        let Some(ChannelBuffer::Sensor(_, temperatures, _)) = self.buffers.get_mut(channel) else {
            return;
        };
        if !celsius.is_finite() {
            return self.counts.not_finite += 1;
        }
        if temperatures.newest().is_some_and(|newest| t <= newest) {
            return self.counts.backward += 1;
        }
        temperatures.push(t, [celsius], quality);
        self.counts.taken += 1;
        // Taken, but too late for a released instant: a replay would use it there.
        let until = Nanos(self.setup.max_wait.0 / 2);
        let is_late = t < self.released.saturating_sub(until);
        self.counts.late += u64::from(self.setup.waits && is_late);
    }

    /// Takes a reading of a skin, whose channels follow those of the robot.
    fn push_skin(&mut self, channel: usize, t: Nanos, reading: &Reading, quality: Quality) {
        let (Some(number), Reading::Skin(skin)) =
            (channel.checked_sub(self.buffers.len()), reading)
        else {
            return;
        };
        match self.contacts.push(number, t, skin, quality) {
            Taken::Yes => {
                self.counts.taken += 1;
                // Taken, but too late for a released instant: a replay would use it there.
                let waits = self.setup.waits;
                let late = waits && self.contacts.is_late(t, self.released);
                self.counts.late += u64::from(late);
            }
            Taken::Backward => self.counts.backward += 1,
            Taken::No => {}
        }
    }

    /// Declares that contact number `contact` has this state from `t` on. A place that makes no
    /// sense (not finite, a direction of zero length) is ignored and counted as not finite.
    pub fn declare(&mut self, contact: usize, t: Nanos, state: &ContactState) {
        if contact >= self.setup.robot.contacts.len() {
            return;
        }
        // Too late for instants that are already released; it counts from the next one on.
        let waits = self.setup.waits;
        self.counts.late += u64::from(waits && t <= self.released);
        let is_good = self.contacts.declare(contact, t, state);
        self.counts.not_finite += u64::from(!is_good);
    }

    /// The stamp of the last sample of channel number `channel` up to `t`, as far as samples are
    /// kept; of a skin, of its newest.
    #[must_use]
    pub fn newest_at(&self, channel: usize, t: Nanos) -> Option<Nanos> {
        match self.buffers.get(channel) {
            Some(buffer) => buffer.newest_at(t),
            None => self.newest(channel),
        }
    }

    /// The stamp of the newest sample of channel number `channel`, of a skin too.
    #[must_use]
    pub fn newest(&self, channel: usize) -> Option<Nanos> {
        match self.buffers.get(channel) {
            Some(buffer) => buffer.newest(),
            None => self
                .contacts
                .newest(channel.checked_sub(self.buffers.len())?),
        }
    }
}

/// What becomes of a sample.
enum Fate {
    Taken,
    NotFinite,
    /// Its instant has been released.
    Late,
    /// It is not later than the last one of its channel.
    Backward,
}

/// A sample that arrives at the buffer of its channel.
struct Arrival<'a> {
    t: Nanos,
    /// As its device has it.
    quality: Quality,
    /// The newest stamp of its channel.
    newest: Nanos,
    /// The stamp of the last estimate, if samples can be late for one.
    released: Option<Nanos>,
    max_silence: Nanos,
    sanity: Option<&'a mut Sanity>,
}

impl Arrival<'_> {
    fn fate(&self, is_finite: bool) -> Fate {
        if !is_finite {
            Fate::NotFinite
        } else if self.released.is_some_and(|released| self.t <= released) {
            Fate::Late
        } else if self.t <= self.newest {
            Fate::Backward
        } else {
            Fate::Taken
        }
    }

    /// Its quality, judged by the samples before it, too.
    fn judged(&mut self, values: [f64; 6]) -> Quality {
        match &mut self.sanity {
            Some(sanity) => sanity.judge(self.t, &values, self.quality, self.max_silence),
            None => self.quality,
        }
    }

    /// Its measured derivatives, as far as they can be true.
    fn derivatives(&mut self, measured: [f64; 3]) -> [f64; 3] {
        match &mut self.sanity {
            Some(sanity) => sanity.derivatives(self.t, measured, self.quality),
            None => measured,
        }
    }

    /// Whether it continues those before it.
    fn is_continued(&self) -> bool {
        !self.quality.intersects(Quality::ZERO_CHANGED)
    }

    fn joint(
        mut self,
        history: &mut History<3>,
        window: &mut Window<1>,
        j: &topics::JointState,
    ) -> Fate {
        let is_finite =
            j.position.is_finite() && is_finite_or_absent(&[j.velocity, j.acceleration]);
        let fate = self.fate(is_finite);
        if matches!(fate, Fate::Taken) {
            const NONE: f64 = f64::NAN;
            let quality = self.judged([j.position, NONE, NONE, NONE, NONE, NONE]);
            let has_stepped = self.sanity.as_ref().is_some_and(|own| own.has_stepped());
            if !self.is_continued() || has_stepped {
                window.interrupt();
            }
            // A position that is not to be trusted is kept, but not differentiated.
            differentiate(
                window,
                self.t,
                [j.position],
                Reason::of_quality(quality, Quality::UNTRUSTED_ENCODER),
            );
            let [velocity, acceleration, _] = self.derivatives([j.velocity, j.acceleration, NONE]);
            history.push(self.t, [j.position, velocity, acceleration], quality);
        }
        fate
    }

    fn wrench(
        mut self,
        history: &mut History<6>,
        predictor: &mut Option<Predictor<6>>,
        w: &topics::Wrench,
    ) -> Fate {
        let ([fx, fy, fz], [tx, ty, tz]) = (w.force, w.torque);
        let value = [fx, fy, fz, tx, ty, tz];
        let fate = self.fate(value.iter().all(|x| x.is_finite()));
        if matches!(fate, Fate::Taken) {
            let quality = self.judged(value);
            let fault = Reason::of_quality(quality, Quality::DEVICE_FAULT);
            self.predict(predictor, &value, fault);
            history.push(self.t, value, quality);
        }
        fate
    }

    fn imu(
        mut self,
        history: &mut History<9>,
        (window, predictor): (&mut Window<3>, &mut Option<Predictor<3>>),
        i: &topics::Imu,
    ) -> Fate {
        let ([ax, ay, az], [gx, gy, gz]) = (i.proper_acceleration, i.angular_velocity);
        let measured = [ax, ay, az, gx, gy, gz];
        let is_finite = measured.iter().all(|x| x.is_finite());
        let fate = self.fate(is_finite && is_finite_or_absent(&i.angular_acceleration));
        if matches!(fate, Fate::Taken) {
            let quality = self.judged(measured);
            let fault = Reason::of_quality(quality, Quality::DEVICE_FAULT);
            self.predict(predictor, &i.proper_acceleration, fault);
            differentiate(window, self.t, i.angular_velocity, fault);
            let [bx, by, bz] = self.derivatives(i.angular_acceleration);
            history.push(self.t, [ax, ay, az, gx, gy, gz, bx, by, bz], quality);
        }
        fate
    }

    /// Gives the sample to the predictor, unless its reading cannot be true.
    fn predict<const D: usize>(
        &self,
        predictor: &mut Option<Predictor<D>>,
        value: &[f64; D],
        fault: Reason,
    ) {
        if let Some(predictor) = predictor
            && fault != Reason::Implausible
        {
            predictor.push(self.t, value, fault == Reason::None, self.is_continued());
        }
    }
}

/// Gives a sample to the window that differentiates, if nothing is wrong with it. One that cannot
/// be true is left out; another fault interrupts the window.
fn differentiate<const D: usize>(window: &mut Window<D>, t: Nanos, value: [f64; D], fault: Reason) {
    match fault {
        Reason::None => {
            let _ = window.push(t, value);
        }
        Reason::Implausible => {}
        _ => window.interrupt(),
    }
}

/// Whether none of these is infinite: what is not measured is not a number.
fn is_finite_or_absent(values: &[f64]) -> bool {
    values.iter().all(|x| !x.is_infinite())
}
