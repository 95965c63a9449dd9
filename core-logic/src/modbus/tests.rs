use super::readings::INPUT_TEXTS;
use super::*;
use crate::configuration::Configuration;
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::vec::Vec as Bytes;

const CAPACITY: u16 = 0x0700;
const ADDRESS: u16 = 0x0900;
const FRONT_END: u16 = 0x0100;

struct Board {
    readings: Readings,
    store: ConfigurationStore,
}

impl Board {
    fn new() -> Self {
        Self {
            readings: Readings::default(),
            store: ConfigurationStore::default(),
        }
    }

    fn ask(&mut self, pdu: &[u8]) -> (Bytes<u8>, Outcome) {
        let mut reply = Vec::<u8, 253>::new();
        let outcome = handle(pdu, &self.readings, &mut self.store, &mut reply);
        (reply.to_vec(), outcome)
    }

    fn read(&mut self, function: u8, address: u16, quantity: u16) -> Result<Bytes<u16>, u8> {
        let [a, b] = address.to_be_bytes();
        let [c, d] = quantity.to_be_bytes();
        let (reply, outcome) = self.ask(&[function, a, b, c, d]);
        assert_eq!(outcome.event, None);
        if reply[0] == function | 0x80 {
            assert_eq!(reply.len(), 2);
            assert_eq!(outcome.exception.map(|e| e as u8), Some(reply[1]));
            return Err(reply[1]);
        }
        assert_eq!(outcome.exception, None);
        assert_eq!(reply[..2], [function, (quantity * 2) as u8]);
        Ok(reply[2..]
            .chunks(2)
            .map(|pair| u16::from_be_bytes([pair[0], pair[1]]))
            .collect())
    }

    fn write_many(&mut self, address: u16, words: &[u16]) -> Result<Option<Event>, u8> {
        let mut pdu = std::vec![0x10];
        pdu.extend(address.to_be_bytes());
        pdu.extend((words.len() as u16).to_be_bytes());
        pdu.push((words.len() * 2) as u8);
        pdu.extend(words.iter().flat_map(|word| word.to_be_bytes()));
        let (reply, outcome) = self.ask(&pdu);
        if reply[0] == 0x90 {
            assert_eq!((reply.len(), outcome.event), (2, None));
            return Err(reply[1]);
        }
        assert_eq!(reply, pdu[..5]);
        Ok(outcome.event)
    }

    fn write_one(&mut self, address: u16, word: u16) -> Result<Option<Event>, u8> {
        let [a, b] = address.to_be_bytes();
        let [c, d] = word.to_be_bytes();
        let pdu = [0x06, a, b, c, d];
        let (reply, outcome) = self.ask(&pdu);
        if reply[0] == 0x86 {
            assert_eq!((reply.len(), outcome.event), (2, None));
            return Err(reply[1]);
        }
        assert_eq!(reply, pdu);
        Ok(outcome.event)
    }
}

fn changed() -> Result<Option<Event>, u8> {
    Ok(Some(Event::ConfigurationChanged))
}

fn readings() -> Readings {
    Readings {
        firmware_version: [1, 2, 3],
        unique_id: [10, 11, 12],
        uptime_s: 0x0001_0002,
        activity: Activity::SupplyCalibration,
        command_state: CommandState::Failed,
        last_command: 0x5A07,
        current: crate::units::Microamps(-1_500_400),
        charge: crate::units::Nanocoulombs(-4_000_000_499),
        range: crate::range::Range::Large,
        diagnoses_active: 1 << 63 | 5,
        last_codes: [9, 8, 7, 6, 5, 4, 3, 255],
        rs485_counters: [1, 2, 3, 4, 5, 6, 7, 8, u32::MAX],
        current_validity: crate::validity::Validity::OPEN,
        configuration_saved: true,
        ..Readings::default()
    }
}

#[test]
fn the_tables_are_in_order_without_overlap() {
    assert_eq!(INPUTS.len(), INPUT_TEXTS.len());
    let mut end = 0;
    let mut names = BTreeSet::new();
    for (row, text) in INPUTS.iter().zip(INPUT_TEXTS) {
        let layout = row.layout;
        assert!(layout.address >= end && layout.count > 0, "{}", text.name);
        assert!(
            layout.kind.width() == 1 || layout.address % 2 == 0,
            "{}",
            text.name
        );
        assert!(names.insert(text.name), "{}", text.name);
        end = layout.end();
    }
}

#[test]
fn each_input_register_reads_its_quantity() {
    let mut board = Board::new();
    board.readings = readings();
    assert_eq!(
        board.read(4, 0x0000, 4),
        Ok([super::readings::MAP_VERSION, 1, 2, 3].to_vec())
    );
    assert_eq!(board.read(4, 0x0006, 6), Ok([0, 10, 0, 11, 0, 12].to_vec()));
    assert_eq!(
        board.read(4, 0x000C, 1),
        Ok([configuration::VERSION].to_vec())
    );
    assert_eq!(board.read(4, 0x000E, 2), Ok([1, 2].to_vec()));
    assert_eq!(board.read(4, 0x0020, 4), Ok([3, 0, 0x5A07, 3].to_vec()));
    assert_eq!(board.read(4, 0x002C, 2), Ok([1, 0].to_vec()));
    // −1,500 mA.
    assert_eq!(board.read(4, 0x0040, 2), Ok([0xFFFF, 0xFA24].to_vec()));
    assert_eq!(board.read(4, 0x0046, 4), Ok([8, 0, 0, 1].to_vec()));
    // −4,000 mC.
    assert_eq!(
        board.read(4, 0x0060, 4),
        Ok([0xFFFF, 0xFFFF, 0xFFFF, 0xF060].to_vec())
    );
    assert_eq!(board.read(4, 0x00C0, 4), Ok([0x8000, 0, 0, 5].to_vec()));
    assert_eq!(
        board.read(4, 0x00C8, 8),
        Ok([9, 8, 7, 6, 5, 4, 3, 255].to_vec())
    );
    assert_eq!(board.read(4, 0x0140, 2), Ok([0xFFFF, 0xFFFF].to_vec()));
    // Every row, all of it, in one request.
    for row in INPUTS {
        let words = row.layout.kind.width() * row.layout.count;
        let got = board.read(4, row.layout.address, words).unwrap();
        let mut expected = Bytes::new();
        for element in 0..usize::from(row.layout.count) {
            let value = row.get(&board.readings, element);
            expected.extend((0..row.layout.kind.width()).map(|w| row.layout.kind.word(value, w)));
        }
        assert_eq!(got, expected);
        // An index that no request can make reads nothing.
        if row.layout.count > 1 {
            assert_eq!(row.get(&board.readings, usize::from(row.layout.count)), 0);
        }
    }
}

#[test]
fn no_two_input_rows_read_the_same_member() {
    // Each member set alone must show in exactly the rows that are made from it.
    macro_rules! shows {
        ($($member:ident = $value:expr => [$($address:literal),*];)*) => {
            $({
                let set = Readings { $member: $value, ..Readings::default() };
                let shown: Bytes<u16> = INPUTS
                    .iter()
                    .filter(|row| {
                        (0..usize::from(row.layout.count))
                            .any(|i| row.get(&set, i) != row.get(&Readings::default(), i))
                    })
                    .map(|row| row.layout.address)
                    .collect();
                assert_eq!(shown, [$($address),*], stringify!($member));
            })*
        };
    }
    use crate::units::*;
    let bad = crate::validity::Validity::STALE;
    shows! {
        firmware_version = [0, 0, 1] => [0x0001];
        revision = 1 => [0x0004];
        unique_id = [0, 1, 0] => [0x0006];
        reset_cause = 1 => [0x000D];
        uptime_s = 1 => [0x000E];
        resets = 1 => [0x0010];
        panic_hash = 1 => [0x0012];
        stack_high_water = 1 => [0x0014];
        snapshot_latency_us = 1 => [0x0016];
        activity = Activity::ZeroDrift => [0x0020];
        activity_progress = 1 => [0x0021];
        last_command = 1 => [0x0022];
        command_state = CommandState::Running => [0x0023];
        command_reason = 1 => [0x0024];
        supply_points = [0, 1] => [0x0025];
        key_calibration_state = 1 => [0x0027];
        configuration_generation = 1 => [0x0028];
        configuration_crc = 1 => [0x002A];
        configuration_saved = true => [0x002C];
        storage_busy = true => [0x002D];
        current = Microamps(1_000_000) => [0x0040, 0x0054];
        current_average = Microamps(1_000_000) => [0x0042];
        meter_current = Microamps(1_000_000) => [0x0044, 0x0056];
        current_validity = bad => [0x0046];
        average_validity = bad => [0x0047];
        meter_validity = bad => [0x0048];
        range = crate::range::Range::Large => [0x0049];
        conversions = 1 => [0x004A];
        sensor_voltage = Microvolts(1) => [0x004C];
        range_edges = 1 => [0x004E];
        coalesced_edges = 1 => [0x0050];
        chatter = 1 => [0x0052];
        charge = Nanocoulombs(500_000) => [0x0060];
        charge_in = Nanocoulombs(1_000_000) => [0x0064];
        charge_out = Nanocoulombs(1_000_000) => [0x0068];
        charge_uncertainty = Nanocoulombs(1_000_000) => [0x006C];
        channel_difference = Nanocoulombs(1_000_000) => [0x0070];
        channel_bound = Nanocoulombs(1_000_000) => [0x0074];
        estimated_intervals = 1 => [0x0078];
        charge_validity = bad => [0x007A];
        soc = Ppm(1) => [0x0080];
        soc_uncertainty = Ppm(1) => [0x0082];
        soc_validity = bad => [0x0084];
        cell_validity = bad => [0x0085];
        remaining_charge = Nanocoulombs(1_000_000) => [0x0086];
        soc_anchors = 1 => [0x008A];
        cell_voltage = Millivolts(1) => [0x008C];
        pack_voltage = Millivolts(1) => [0x008E];
        supply = Microvolts(1) => [0x00A0];
        network_voltage = Microvolts(1) => [0x00A2];
        mcu_supply = Millivolts(1) => [0x00A4];
        sensor_temperature = MilliCelsius(1) => [0x00A6];
        board_temperature = MilliCelsius(1) => [0x00A8];
        supply_validity = bad => [0x00AA];
        temperature_validity = bad => [0x00AB];
        key_state = 1 => [0x00AC];
        high_voltage_on = true => [0x00AD];
        high_voltage_permit = true => [0x00AE];
        diagnoses_active = 1 => [0x00C0];
        diagnoses_latched = 1 => [0x00C4];
        last_codes = [0, 0, 0, 0, 0, 0, 0, 1] => [0x00C8];
        meter_counters = [0, 0, 0, 0, 1] => [0x0100];
        converter_counters = [0, 0, 0, 0, 1] => [0x0110];
        can_counters = [0, 0, 0, 0, 0, 1] => [0x0120];
        rs485_counters = [0, 0, 0, 0, 0, 0, 0, 0, 1] => [0x0130];
        flash_counters = [0, 0, 0, 0, 1] => [0x0148];
    }
}

#[test]
fn every_setting_can_be_read_and_written() {
    let mut board = Board::new();
    for field in FIELDS {
        let words = field.layout.kind.width() * field.layout.count;
        let got = board.read(3, field.layout.address, words).unwrap();
        let kind = field.layout.kind;
        let expected: Bytes<u16> = (0..usize::from(field.layout.count))
            .flat_map(|element| {
                let value = field.get(board.store.active(), element).unwrap_or(0);
                (0..kind.width()).map(move |word| kind.word(value, word))
            })
            .collect();
        assert_eq!(got, expected);
        let used = field.get(board.store.active(), 0).is_some();
        // What is there can be written back; what belongs to another front end cannot.
        let answer = board.write_many(field.layout.address, &got);
        assert_eq!(answer, if used { changed() } else { Err(3) }, "{field:?}");
    }
    assert_eq!(*board.store.active(), Configuration::default());
}

#[test]
fn both_halves_of_a_wide_value_come_in_one_request() {
    let mut board = Board::new();
    let before = *board.store.active();
    // 1,000,000 mAh = 0x000F_4240.
    assert_eq!(board.write_one(CAPACITY, 0x000F), Err(3));
    assert_eq!(board.write_one(CAPACITY + 1, 0x4240), Err(3));
    assert_eq!(board.write_many(CAPACITY + 1, &[0x4240]), Err(3));
    assert_eq!(board.write_many(CAPACITY, &[0x000F]), Err(3));
    assert_eq!(board.write_many(CAPACITY, &[0x000F, 0x4240, 0]), Err(3));
    assert_eq!(board.write_many(CAPACITY + 1, &[0x4240, 0, 1]), Err(3));
    assert_eq!(
        (*board.store.active(), board.store.generation()),
        (before, 0)
    );
    assert_eq!(board.write_many(CAPACITY, &[0x000F, 0x4240]), changed());
    assert_eq!(board.store.active().soc.capacity_mah, 1_000_000);
    assert_eq!(board.read(3, CAPACITY, 1), Err(3));
    assert_eq!(board.read(3, CAPACITY + 1, 1), Err(3));
    assert_eq!(board.read(3, CAPACITY + 1, 2), Err(3));
    assert_eq!(board.read(3, CAPACITY, 2), Ok([0x000F, 0x4240].to_vec()));
    assert_eq!(board.read(4, 0x0060, 3), Err(3));
    assert_eq!(board.read(4, 0x0061, 3), Err(3));
}

#[test]
fn a_write_of_many_is_carried_out_whole_or_not_at_all() {
    let mut board = Board::new();
    let before = *board.store.active();
    // Address 5 is good, a turnaround of 50,001 µs is not.
    assert_eq!(board.write_many(ADDRESS, &[5, 50_001]), Err(3));
    // The gap behind it.
    assert_eq!(board.write_many(ADDRESS, &[5, 3_000, 0]), Err(2));
    assert_eq!(
        (*board.store.active(), board.store.generation()),
        (before, 0)
    );
    assert_eq!(board.write_many(ADDRESS, &[5, 50_000]), changed());
    assert_eq!(board.store.active().rtu.address, 5);
    assert_eq!(board.store.active().rtu.turnaround_us, 50_000);
    assert_eq!(board.write_one(ADDRESS, 0), Err(3));
    assert_eq!(board.write_one(ADDRESS, 248), Err(3));
    assert_eq!(board.write_one(ADDRESS, 247), changed());
    assert_eq!(board.store.generation(), 2);
    // In limits, but the points do not rise.
    assert_eq!(board.write_many(0x0782, &[0, 5, 0, 5]), Err(3));
    assert_eq!(board.store.generation(), 2);
}

#[test]
fn the_parameters_of_another_front_end_are_written_with_it() {
    let mut board = Board::new();
    assert_eq!(board.write_many(0x0112, &[0x17D7, 0x8400]), Err(3));
    assert_eq!(board.write_one(FRONT_END, 4), Err(3));
    assert_eq!(board.write_one(FRONT_END, 1), changed());
    assert_eq!(board.write_many(0x0112, &[0x17D7, 0x8400]), changed());
    assert_eq!(
        board
            .store
            .active()
            .front_end
            .full_scale(crate::range::Range::Small),
        crate::units::Microamps::from_amps(400)
    );
    // The meter follows the front end by itself: 2.25 V / 4 mV/A.
    assert_eq!(
        board.store.active().meter.full_scale.small,
        crate::units::Microamps(562_500_000)
    );
}

#[test]
fn what_is_not_there_is_an_illegal_address() {
    let mut board = Board::new();
    for (function, address, quantity) in [
        (3, 1, 1),
        (3, 0, 2),
        (3, 0x00FF, 1),
        (3, 0x0101, 1),
        (3, 0x0100, 2),
        (3, 0xFFFF, 1),
        (3, 0xFFFF, 2),
        (4, 0x0018, 1),
        (4, 0x0017, 1 + 1),
        (4, 0xFFFF, 125),
    ] {
        assert_eq!(
            board.read(function, address, quantity),
            Err(2),
            "{address:#x}"
        );
    }
    assert_eq!(board.write_one(0x0001, 0), Err(2));
    assert_eq!(
        board.write_many(0x0000, &[Command::Save.register(), 0]),
        Err(2)
    );
    assert_eq!(board.write_many(0xFFFF, &[0, 0]), Err(2));
    // Of two faults the address is named first.
    assert_eq!(board.write_many(CAPACITY - 1, &[0, 0]), Err(2));
}

#[test]
fn requests_of_the_wrong_shape_are_illegal_values() {
    let mut board = Board::new();
    for pdu in [
        &[0x03][..],
        &[0x03, 0, 0, 0],
        &[0x03, 0, 0, 0, 1, 0],
        &[0x03, 0, 0, 0, 0],
        &[0x03, 0, 0, 0, 126],
        &[0x03, 0, 0, 1, 1],
        &[0x04, 0, 0, 0, 0],
        &[0x04, 0, 0, 0, 126],
        &[0x04, 0, 0],
        &[0x06, 9, 0, 0],
        &[0x06, 9, 0, 0, 1, 0],
        &[0x10],
        &[0x10, 9, 0, 0, 1],
        &[0x10, 9, 0, 0, 0, 0],
        &[0x10, 9, 0, 0, 1, 2],
        &[0x10, 9, 0, 0, 1, 2, 0],
        &[0x10, 9, 0, 0, 1, 2, 0, 1, 0],
        &[0x10, 9, 0, 0, 1, 3, 0, 1, 0],
        &[0x10, 9, 0, 0, 2, 2, 0, 1],
        &[0x10, 9, 0, 0, 1, 4, 0, 1, 0, 1],
    ] {
        let (reply, outcome) = board.ask(pdu);
        assert_eq!(reply, [pdu[0] | 0x80, 3], "{pdu:x?}");
        assert_eq!(outcome.exception, Some(Exception::IllegalDataValue));
    }
    let mut long = std::vec![0x10, 9, 0, 0, 124, 248];
    long.extend([0; 248]);
    assert_eq!(board.ask(&long).0, [0x90, 3]);
    // 123 is allowed, there is only no such block: the address is at fault.
    let mut longest = std::vec![0x10, 9, 0, 0, 123, 246];
    longest.extend([0; 246]);
    assert_eq!(board.ask(&longest).0, [0x90, 2]);
    assert_eq!(board.read(4, 0, 125), Err(2));
    assert_eq!(*board.store.active(), Configuration::default());
}

#[test]
fn other_functions_are_illegal() {
    let mut board = Board::new();
    for function in (0..=255u8).filter(|f| ![3, 4, 6, 16].contains(f)) {
        let (reply, outcome) = board.ask(&[function, 0, 0, 0, 1]);
        assert_eq!(reply, [function | 0x80, 1]);
        assert_eq!(outcome.exception, Some(Exception::IllegalFunction));
    }
    assert_eq!(board.ask(&[]).0, [0x80, 1]);
}

#[test]
fn an_answer_that_does_not_fit_is_a_failure_and_not_a_part_of_an_answer() {
    let mut board = Board::new();
    let mut reply = Vec::<u8, 5>::new();
    let outcome = handle(
        &[4, 0, 0, 0, 2],
        &board.readings,
        &mut board.store,
        &mut reply,
    );
    assert_eq!(outcome.exception, Some(Exception::ServerDeviceFailure));
    assert_eq!(reply[..], [0x84, 4]);
}

#[test]
fn what_changes_the_measurement_waits_for_standstill() {
    let mut board = Board::new();
    let frozen = |board: &mut Board, exception: u8| {
        for field in FIELDS {
            let words = usize::from(field.layout.kind.width());
            let answer = board.write_many(field.layout.address, &[0u16, 0, 0, 0][..words]);
            match field.when {
                When::Standstill => assert_eq!(answer, Err(exception), "{field:?}"),
                When::Always => assert!(answer == Err(3) || answer == changed(), "{field:?}"),
            }
        }
    };
    board.readings.high_voltage_on = true;
    frozen(&mut board, 4);
    board.readings.activity = Activity::ZeroDrift;
    frozen(&mut board, 4);
    board.readings.high_voltage_on = false;
    for activity in [
        Activity::ZeroDrift,
        Activity::KeyCalibration,
        Activity::SupplyCalibration,
    ] {
        board.readings.activity = activity;
        frozen(&mut board, 6);
    }
    board.readings.activity = Activity::None;
    board.readings.high_voltage_permit = true;
    frozen(&mut board, 4);
    assert_eq!(board.write_one(FRONT_END, 1), Err(4));
    assert_eq!(board.write_one(ADDRESS, 3), changed());
    board.readings.high_voltage_permit = false;
    assert_eq!(board.write_one(FRONT_END, 1), changed());
}

#[test]
fn settings_wait_for_a_save_and_not_for_the_log() {
    let mut board = Board::new();
    board.readings.storage_busy = true;
    assert_eq!(board.write_one(ADDRESS, 3), changed());
    board.readings.configuration_in_transfer = true;
    assert_eq!(board.write_one(ADDRESS, 4), Err(6));
    assert_eq!(board.write_one(ADDRESS + 2, 4), Err(2));
    assert_eq!(board.store.active().rtu.address, 3);
    assert_eq!(board.read(3, ADDRESS, 1), Ok([3].to_vec()));
    // Nor is anything taken of a sensor whose correction a restore is about to replace.
    for order in [0x5A01, 0x5A02, 0x5A03, 0x5A04] {
        assert_eq!(
            board.write_one(COMMAND_ADDRESS, order),
            Err(6),
            "{order:#x}"
        );
    }
    board.readings.activity = Activity::SupplyCalibration;
    for order in [0x5A03, 0x5A04, 0x5A05] {
        assert_eq!(
            board.write_one(COMMAND_ADDRESS, order),
            Err(6),
            "{order:#x}"
        );
    }
    board.readings.high_voltage_on = true;
    assert_eq!(board.write_one(COMMAND_ADDRESS, 0x5A01), Err(4));
    // An order that the flash has no part in.
    assert!(board.write_one(COMMAND_ADDRESS, 0x5A06).is_ok());
}

#[test]
fn a_corrupted_configuration_takes_no_change() {
    let mut board = Board::new();
    board.store.corrupt();
    assert_eq!(board.write_one(ADDRESS, 3), Err(4));
    board.store.factory_defaults();
    assert_eq!(board.write_one(ADDRESS, 3), changed());
}

#[test]
fn commands_need_their_key() {
    let mut board = Board::new();
    board.readings.last_command = 0x5A03;
    assert_eq!(board.read(3, COMMAND_ADDRESS, 1), Ok([0x5A03].to_vec()));
    let mut numbers = BTreeSet::new();
    for (index, (command, name, _)) in Command::ALL.into_iter().enumerate() {
        let value = 0x5A01 + index as u16;
        assert_eq!(command.register(), value, "{name}");
        assert_eq!(Command::from_register(value), Some(command));
        assert!(numbers.insert(value));
    }
    for value in 0..=u16::MAX {
        if !numbers.contains(&value) {
            assert_eq!(Command::from_register(value), None);
        }
    }
    for value in [0, 1, 7, 0x5A00, 0x5A0C, 0xA507, 0x5B07] {
        assert_eq!(board.write_one(COMMAND_ADDRESS, value), Err(3));
    }
    let save = Ok(Some(Event::Command(Command::Save)));
    assert_eq!(board.write_one(COMMAND_ADDRESS, 0x5A07), save);
    assert_eq!(board.write_many(COMMAND_ADDRESS, &[0x5A07]), save);
    assert_eq!(board.store.generation(), 0);
}

#[test]
fn commands_need_their_state() {
    use Activity as A;
    use Command as C;
    // (high voltage, activity, flash busy) and the answer to each command, 0 for accepted.
    let quiet = (false, A::None, false);
    let cases = [
        (C::ZeroNow, quiet, 0),
        (C::ZeroNow, (true, A::None, false), 4),
        (C::ZeroNow, (false, A::ZeroDrift, false), 6),
        (C::ZeroNow, (false, A::SupplyCalibration, false), 6),
        (C::ZeroNow, (false, A::None, true), 6),
        (C::StartKeyCalibration, (false, A::None, true), 6),
        (C::SupplyPointAtZero, (false, A::None, true), 6),
        (
            C::SupplyPointAtCurrent,
            (false, A::SupplyCalibration, true),
            6,
        ),
        (
            C::FinishSupplyCalibration,
            (false, A::SupplyCalibration, true),
            6,
        ),
        (C::ClearLog, (false, A::ZeroDrift, false), 6),
        (C::StartKeyCalibration, quiet, 0),
        (C::StartKeyCalibration, (true, A::None, false), 4),
        (C::StartKeyCalibration, (false, A::KeyCalibration, false), 6),
        (C::SupplyPointAtZero, quiet, 0),
        (C::SupplyPointAtZero, (true, A::None, false), 4),
        (
            C::SupplyPointAtZero,
            (false, A::SupplyCalibration, false),
            0,
        ),
        (C::SupplyPointAtZero, (false, A::ZeroDrift, false), 6),
        (C::SupplyPointAtZero, (false, A::KeyCalibration, false), 6),
        (
            C::SupplyPointAtCurrent,
            (true, A::SupplyCalibration, false),
            4,
        ),
        (
            C::SupplyPointAtCurrent,
            (false, A::SupplyCalibration, false),
            0,
        ),
        (
            C::SupplyPointAtCurrent,
            (false, A::KeyCalibration, false),
            6,
        ),
        (C::FinishSupplyCalibration, quiet, 4),
        (
            C::FinishSupplyCalibration,
            (false, A::SupplyCalibration, false),
            0,
        ),
        (
            C::FinishSupplyCalibration,
            (true, A::SupplyCalibration, false),
            4,
        ),
        (C::FinishSupplyCalibration, (false, A::ZeroDrift, false), 6),
        (
            C::FinishSupplyCalibration,
            (false, A::KeyCalibration, false),
            6,
        ),
        (C::Abort, quiet, 0),
        (C::Abort, (true, A::KeyCalibration, true), 0),
        (C::Save, (true, A::None, false), 0),
        (C::Save, (false, A::ZeroDrift, false), 6),
        (C::Save, (false, A::KeyCalibration, false), 0),
        (C::Save, (false, A::SupplyCalibration, false), 0),
        (C::Save, (false, A::None, true), 6),
        (C::Restore, quiet, 0),
        (C::Restore, (true, A::None, false), 4),
        (C::Restore, (false, A::KeyCalibration, false), 6),
        (C::Restore, (false, A::None, true), 6),
        (C::Restore, (true, A::None, true), 4),
        (C::FactoryDefaults, quiet, 0),
        (C::FactoryDefaults, (true, A::None, false), 4),
        (C::FactoryDefaults, (false, A::SupplyCalibration, false), 6),
        (C::FactoryDefaults, (false, A::None, true), 6),
        (C::ClearLog, quiet, 0),
        (C::ClearLog, (true, A::None, false), 4),
        (C::ClearLog, (true, A::None, true), 4),
        (C::ClearLog, (false, A::ZeroDrift, true), 6),
        (C::ClearDiagnoses, (true, A::KeyCalibration, true), 0),
    ];
    for (command, (high_voltage, activity, busy), answer) in cases {
        for permit in [false, true] {
            let mut board = Board::new();
            board.readings.high_voltage_on = high_voltage && !permit;
            board.readings.high_voltage_permit = high_voltage && permit;
            board.readings.activity = activity;
            board.readings.storage_busy = busy;
            let expected = match answer {
                0 => Ok(Some(Event::Command(command))),
                code => Err(code),
            };
            assert_eq!(
                board.write_one(COMMAND_ADDRESS, command.register()),
                expected,
                "{command:?} {activity:?} {high_voltage} {busy}"
            );
        }
    }
    let idle = "high voltage off, no calibration under way, flash not busy";
    for command in [C::ZeroNow, C::Restore, C::ClearLog] {
        assert_eq!(board_text(command), idle);
    }
    assert_eq!(
        board_text(C::SupplyPointAtZero),
        "high voltage off, no other calibration under way, flash not busy"
    );
    assert_eq!(
        board_text(C::FinishSupplyCalibration),
        "high voltage off, supply calibration under way, flash not busy"
    );
    assert_eq!(board_text(C::Save), "no zero run under way, flash not busy");
    assert_eq!(board_text(C::Abort), "always");
}

fn board_text(command: Command) -> &'static str {
    command.when().text()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn no_request_panics_and_only_an_event_changes_anything(
        function in prop_oneof![Just(3u8), Just(4), Just(6), Just(16), any::<u8>()],
        data in prop::collection::vec(any::<u8>(), 0..255),
    ) {
        let mut board = Board::new();
        let mut pdu = std::vec![function];
        pdu.extend(data);
        let before = *board.store.active();
        let (reply, outcome) = board.ask(&pdu);
        prop_assert!(reply[0] & 0x7F == function & 0x7F);
        prop_assert_eq!(outcome.exception.is_some(), reply[0] == function | 0x80);
        if outcome.event != Some(Event::ConfigurationChanged) {
            prop_assert_eq!(*board.store.active(), before);
        }
    }

    #[test]
    fn what_was_written_is_read_back_or_nothing_has_changed(
        row: prop::sample::Index,
        skip in 0..4u16,
        words in prop::collection::vec(prop_oneof![0..200u16, any::<u16>()], 1..8),
    ) {
        let mut board = Board::new();
        let address = FIELDS[row.index(FIELDS.len())].layout.address + skip;
        let before = *board.store.active();
        let answer = board.write_many(address, &words);
        if answer == changed() {
            prop_assert_eq!(board.read(3, address, words.len() as u16), Ok(words));
            prop_assert_eq!(board.store.active().validate(), Ok(()));
            prop_assert_eq!(board.store.generation(), 1);
        } else {
            prop_assert!(matches!(answer, Err(2 | 3)));
            prop_assert_eq!((*board.store.active(), board.store.generation()), (before, 0));
        }
    }
}
