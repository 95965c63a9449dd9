//! The Modbus server against the client side of `rmodbus`, which shares no code with it.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]

use core_logic::configuration::{ConfigurationStore, FIELDS};
use core_logic::modbus::{Command, Event, INPUTS, Readings};
use core_logic::modbus_rtu::{LineErrors, Server};
use core_logic::units::{Instant, Microamps, Nanocoulombs};
use proptest::prelude::*;
use rmodbus::client::ModbusRequest;
use rmodbus::{ErrorKind, ModbusProto, guess_response_frame_len};

struct Wire {
    server: Server,
    store: ConfigurationStore,
    readings: Readings,
    now: u64,
    event: Option<Event>,
}

impl Wire {
    fn new() -> Self {
        Self {
            server: Server::new(Instant::from_ticks(0)),
            store: ConfigurationStore::default(),
            readings: Readings::default(),
            now: 10_000,
            event: None,
        }
    }

    /// Sends a frame and returns the answer, if there is one.
    fn exchange(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        for byte in frame {
            self.now += 96;
            let end = Instant::from_ticks(self.now);
            self.server.on_character(*byte, LineErrors::NONE, end);
        }
        self.now += 2_000;
        let now = Instant::from_ticks(self.now);
        let served = self.server.serve(now, &self.readings, &mut self.store)?;
        self.event = served.event;
        let (reply, _) = served.reply?;
        // The client would read by this length from the line.
        let length = guess_response_frame_len(reply, ModbusProto::Rtu).unwrap();
        assert_eq!(usize::from(length), reply.len());
        Some(reply.to_vec())
    }

    fn ask(
        &mut self,
        generate: impl FnOnce(&mut ModbusRequest, &mut Vec<u8>) -> Result<(), ErrorKind>,
    ) -> Result<Vec<u16>, ErrorKind> {
        let mut request = ModbusRequest::new(1, ModbusProto::Rtu);
        let mut frame = Vec::new();
        generate(&mut request, &mut frame).unwrap();
        let reply = self.exchange(&frame).expect("an answer");
        request.parse_ok(&reply)?;
        let mut words = Vec::new();
        if matches!(frame[1], 3 | 4) {
            request.parse_u16(&reply, &mut words)?;
        }
        Ok(words)
    }

    fn inputs(&mut self, address: u16, count: u16) -> Result<Vec<u16>, ErrorKind> {
        self.ask(|request, frame| request.generate_get_inputs(address, count, frame))
    }

    fn holdings(&mut self, address: u16, count: u16) -> Result<Vec<u16>, ErrorKind> {
        self.ask(|request, frame| request.generate_get_holdings(address, count, frame))
    }

    fn set(&mut self, address: u16, words: &[u16]) -> Result<(), ErrorKind> {
        self.ask(|request, frame| request.generate_set_holdings_bulk(address, words, frame))
            .map(|_| ())
    }

    fn set_one(&mut self, address: u16, word: u16) -> Result<(), ErrorKind> {
        self.ask(|request, frame| request.generate_set_holding(address, word, frame))
            .map(|_| ())
    }
}

#[test]
fn a_client_reads_current_and_charge() {
    let mut wire = Wire::new();
    wire.readings.current = Microamps(-123_456_789);
    wire.readings.charge = Nanocoulombs(-5_000_000_000_000);
    let words = wire.inputs(0x0040, 2).unwrap();
    let current = (u32::from(words[0]) << 16 | u32::from(words[1])) as i32;
    assert_eq!(current, -123_457);
    let words = wire.inputs(0x0060, 4).unwrap();
    let charge = words
        .iter()
        .fold(0u64, |bits, word| bits << 16 | u64::from(*word)) as i64;
    assert_eq!(charge, -5_000_000);
}

#[test]
fn a_client_reads_every_register_of_both_tables() {
    let mut wire = Wire::new();
    for layout in INPUTS.iter().map(|row| row.layout) {
        let words = layout.end() - layout.address;
        assert_eq!(
            wire.inputs(layout.address, words).unwrap().len(),
            usize::from(words)
        );
    }
    for layout in FIELDS.iter().map(|row| row.layout) {
        let words = layout.end() - layout.address;
        let got = wire.holdings(layout.address, words).unwrap();
        assert_eq!(got.len(), usize::from(words));
    }
}

#[test]
fn a_client_writes_and_orders() {
    let mut wire = Wire::new();
    wire.set(0x0700, &[0x0001, 0x86A0]).unwrap();
    assert_eq!(wire.event, Some(Event::ConfigurationChanged));
    assert_eq!(wire.store.active().soc.capacity_mah, 100_000);
    assert_eq!(wire.holdings(0x0700, 2), Ok(vec![0x0001, 0x86A0]));
    wire.set_one(0x0000, Command::ZeroNow.register()).unwrap();
    assert_eq!(wire.event, Some(Event::Command(Command::ZeroNow)));
}

#[test]
fn a_client_sees_the_exceptions() {
    let mut wire = Wire::new();
    assert_eq!(wire.inputs(0x0018, 1), Err(ErrorKind::IllegalDataAddress));
    assert_eq!(wire.holdings(0x0700, 1), Err(ErrorKind::IllegalDataValue));
    assert_eq!(wire.set_one(0x0700, 1), Err(ErrorKind::IllegalDataValue));
    assert_eq!(wire.set(0x0700, &[0, 0]), Err(ErrorKind::IllegalDataValue));
    let coils = wire.ask(|request, frame| request.generate_get_coils(0, 1, frame));
    assert_eq!(coils, Err(ErrorKind::IllegalFunction));
    wire.readings.high_voltage_on = true;
    assert_eq!(wire.set_one(0x0100, 1), Err(ErrorKind::SlaveDeviceFailure));
    wire.readings.high_voltage_on = false;
    wire.readings.storage_busy = true;
    let save = Command::Save.register();
    assert_eq!(wire.set_one(0x0000, save), Err(ErrorKind::SlaveDeviceBusy));
    assert_eq!(wire.event, None);
    assert_eq!(wire.store.generation(), 0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn any_read_and_any_write_of_the_client_is_understood(
        address in prop_oneof![0..0x0200u16, 0x0700..0x0910u16, any::<u16>()],
        words in prop::collection::vec(any::<u16>(), 1..124),
        count in 1..=125u16,
    ) {
        let mut wire = Wire::new();
        for answer in [
            wire.inputs(address, count).map(|words| prop_len(&words, count)),
            wire.holdings(address, count).map(|words| prop_len(&words, count)),
            wire.set(address, &words),
            wire.set_one(address, words[0]),
        ] {
            prop_assert!(matches!(
                answer,
                Ok(()) | Err(ErrorKind::IllegalDataAddress | ErrorKind::IllegalDataValue)
            ));
        }
    }

    #[test]
    fn a_frame_with_a_flipped_bit_is_never_answered(
        words in prop::collection::vec(any::<u16>(), 1..20),
        bit: prop::sample::Index,
    ) {
        let mut request = ModbusRequest::new(1, ModbusProto::Rtu);
        let mut frame = Vec::new();
        request.generate_set_holdings_bulk(0x0900, &words, &mut frame).unwrap();
        let bit = bit.index(frame.len() * 8);
        frame[bit / 8] ^= 1 << (bit % 8);
        let mut wire = Wire::new();
        prop_assert_eq!(wire.exchange(&frame), None);
        prop_assert_eq!(wire.store.generation(), 0);
    }
}

fn prop_len(words: &[u16], count: u16) {
    assert_eq!(words.len(), usize::from(count));
}
