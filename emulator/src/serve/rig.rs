//! A rig for clients, without anything written down.

use anyhow::Result;

use crate::can_frame::CanFrame;
use crate::rig::Rig;
use crate::time::Ticks;

/// The frames are there if `keep_frames` is set.
impl super::Board for Rig<'_> {
    fn run_for(&mut self, us: u64) -> Result<()> {
        Rig::run_for(self, Ticks::from_micros(us))
    }

    fn now_s(&self) -> f64 {
        Rig::now_s(self)
    }

    fn inject_can(&mut self, frame: CanFrame) {
        self.send_can(frame);
    }

    fn take_can(&mut self) -> Vec<(f64, CanFrame)> {
        self.frames
            .drain(..)
            .map(|logged| (logged.at.seconds(), logged.frame))
            .collect()
    }

    fn inject_rs485(&mut self, bytes: &[u8]) {
        self.send_rs485(bytes);
    }

    fn take_rs485(&mut self) -> Vec<u8> {
        Rig::take_rs485(self)
    }
}
