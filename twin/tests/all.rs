//! All tests of the tool that need no private item, in one program: one to link, and to keep, in the place of thirty.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "common/cell.rs"]
mod cell;
#[path = "common/command.rs"]
mod command;
mod common;
#[path = "../../core-logic/tests/support/host_board.rs"]
mod host_board;
#[path = "../../core-logic/tests/support/ideal_board.rs"]
mod ideal_board;
mod report_sample;

mod bad_input;
mod battery_begin;
mod battery_current_zero;
mod battery_gaps;
mod battery_resistance;
mod battery_start;
mod battery_temperature;
mod between_rows;
mod censored_readings;
mod coarse_readings;
mod concealed;
mod concealed_battery;
mod convert;
mod dropouts;
mod end_of_search;
mod explain_command;
mod gaps;
mod held_reference;
mod long_recordings;
mod model;
mod no_physics_of_the_library;
mod noisy_reference;
mod one_swing;
mod panasonic_model;
mod prepare;
mod real_recordings;
mod report;
mod report_page;
mod simulate;
mod slips;
mod steady_currents;
mod tester_log;
mod two_clocks;
