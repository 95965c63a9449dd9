//! All tests of the emulated board that need no private item, in one program: one to link, and both cores busy to its end.

#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod serve_support;
mod support;

mod calibration_round;
mod cpu_differential;
mod design_d0_dual_range_switching;
mod design_d1_hardware_charge;
mod design_d2_measuring_chain;
mod design_d3_open_sensor;
mod design_d4_key_state_calibration;
mod design_soc_rest_re_anchors;
mod drive_command;
mod faults;
mod firmware_image;
mod serve_image;
mod serve_python;
mod serve_session;
mod serve_socketcand;
