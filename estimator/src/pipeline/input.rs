//! The pipeline's input: samples, of skins too, and declarations of contacts.

use super::Pipeline;
use super::buffers::ChannelBuffer;
use crate::config::Timing;
use crate::skin::Taken;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{ContactState, Nanos, Quality, Reading, Reason};

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
        let waits = self.setup.timing == Timing::Aligned;
        let newest = buffer.newest().unwrap_or(Nanos::MIN);
        let all_finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        let finite_or_absent = |values: &[f64]| values.iter().all(|v| !v.is_infinite());
        let is_continued = !quality.intersects(Quality::ZERO_CHANGED);
        let max_silence = self.setup.robot.max_silence;
        let mut sanity = self.sanity.get_mut(channel);
        let mut judged = |values: [f64; 6]| match &mut sanity {
            Some(sanity) => sanity.look(t, &values, quality, max_silence),
            None => quality,
        };
        // Decide first whether the sample may be taken; then push it to window and history.
        let (mut late, mut backward) = (false, false);
        let mut admit = |is_valid: bool| {
            late = waits && is_valid && t <= self.released;
            backward = is_valid && !late && t <= newest;
            is_valid && !late && !backward
        };
        let is_valid = match (buffer, reading) {
            (ChannelBuffer::Joint(history, window), Reading::Joint(j)) => {
                let is_valid =
                    j.position.is_finite() && finite_or_absent(&[j.velocity, j.acceleration]);
                if j.position.is_nan() {
                    // For example a row with a torque alone: nothing to differentiate.
                    return;
                }
                if admit(is_valid) {
                    const NONE: f64 = f64::NAN;
                    let quality = judged([j.position, NONE, NONE, NONE, NONE, NONE]);
                    if !is_continued || sanity.is_some_and(|sanity| sanity.has_stepped()) {
                        window.interrupt();
                    }
                    // A position that is not to be trusted is kept, but not differentiated.
                    match Reason::of_quality(quality, Quality::UNTRUSTED_ENCODER) {
                        Reason::None => {
                            let _ = window.push(t, [j.position]);
                        }
                        Reason::Implausible => {}
                        _ => window.interrupt(),
                    }
                    history.push(t, [j.position, j.velocity, j.acceleration], quality);
                }
                is_valid
            }
            (ChannelBuffer::Sensor(_, temperatures, _), Reading::Temperature(temperature)) => {
                if !self.setup.depends_on_temperature(channel)
                    || quality.intersects(Quality::DEVICE_FAULT)
                {
                    return;
                }
                let late = waits
                    && t < self
                        .released
                        .saturating_sub(Nanos(self.setup.max_wait.0 / 2));
                match temperature.celsius.is_finite() {
                    false => self.counts.not_finite += 1,
                    true if temperatures.newest().is_some_and(|newest| t <= newest) => {
                        self.counts.backward += 1;
                    }
                    true => {
                        temperatures.push(t, [temperature.celsius], quality);
                        self.counts.taken += 1;
                        // Taken, but too late for a released instant: a replay would use it there.
                        self.counts.late += u64::from(late);
                    }
                }
                return;
            }
            (ChannelBuffer::Sensor(history, _, predictor), Reading::Wrench(w)) => {
                let ([fx, fy, fz], [tx, ty, tz]) = (w.force, w.torque);
                let value = [fx, fy, fz, tx, ty, tz];
                let is_valid = all_finite(&value);
                if admit(is_valid) {
                    let quality = judged(value);
                    let fault = Reason::of_quality(quality, Quality::DEVICE_FAULT);
                    if let Some(predictor) = predictor
                        && fault != Reason::Implausible
                    {
                        predictor.push(t, &value, fault == Reason::None, is_continued);
                    }
                    history.push(t, value, quality);
                }
                // The first reading is of the zero that the configuration is of. A reading that is
                // of no use tells of a new zero all the same.
                if !is_continued
                    && newest > Nanos::MIN
                    && let Some(ChannelRole::Sensor(number)) = role
                    && let Some(since) = self.new_zeros.get_mut(number)
                {
                    since.get_or_insert(newest);
                    if let Some(identification) = &mut self.identification {
                        identification.begin_zero(number, t);
                    }
                }
                is_valid
            }
            (ChannelBuffer::Imu(history, window, predictor), Reading::Imu(i)) => {
                let is_valid = all_finite(&i.proper_acceleration)
                    && all_finite(&i.angular_velocity)
                    && finite_or_absent(&i.angular_acceleration);
                if admit(is_valid) {
                    let ([ax, ay, az], [gx, gy, gz]) = (i.proper_acceleration, i.angular_velocity);
                    let quality = judged([ax, ay, az, gx, gy, gz]);
                    let fault = Reason::of_quality(quality, Quality::DEVICE_FAULT);
                    if let Some(predictor) = predictor
                        && fault != Reason::Implausible
                    {
                        let is_good = fault == Reason::None;
                        predictor.push(t, &i.proper_acceleration, is_good, is_continued);
                    }
                    match fault {
                        Reason::None => {
                            let _ = window.push(t, i.angular_velocity);
                        }
                        Reason::Implausible => {}
                        _ => window.interrupt(),
                    }
                    let [bx, by, bz] = i.angular_acceleration;
                    history.push(t, [ax, ay, az, gx, gy, gz, bx, by, bz], quality);
                }
                is_valid
            }
            _ => return,
        };
        self.counts.not_finite += u64::from(!is_valid);
        self.counts.late += u64::from(late);
        self.counts.backward += u64::from(backward);
        if !is_valid || late || backward {
            return;
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
                let waits = self.setup.timing == Timing::Aligned;
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
        let waits = self.setup.timing == Timing::Aligned;
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
