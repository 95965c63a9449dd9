//! The emulated board: the unmodified firmware image on an STM32F405, wired to the physical world of `plant`.

pub mod bench;
pub mod board;
pub mod bus_view;
pub mod calibration;
pub mod can_bus;
pub mod can_frame;
pub mod cpu;
pub mod drive;
pub mod faults;
pub mod i2c_bus;
pub mod image;
pub mod machine;
pub mod mcu;
pub mod outside;
pub mod profile;
pub mod rig;
pub mod rs485_line;
pub mod rtt;
pub mod scenario;
pub mod sensors;
pub mod serve;
pub mod time;
pub mod vehicle;
