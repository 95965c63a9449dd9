//! MDF 4 files made block by block: what the writers at hand do not make, and damage.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use proptest::prelude::*;
use recording::{error::Kind, log::Frame, mdf};

/// A file under construction. Blocks can only point to those that are there already, so they are made from the end.
struct Maker(Vec<u8>);

impl Maker {
    fn new() -> Self {
        let mut bytes = b"MDF     4.10    tests   ".to_vec();
        // Identification of 64 bytes, then the header block of 24 + 6 * 8 + 32.
        bytes.resize(64 + 104, 0);
        Self(bytes)
    }

    fn block(&mut self, id: &str, links: &[u64], data: &[u8]) -> u64 {
        while !self.0.len().is_multiple_of(8) {
            self.0.push(0);
        }
        let address = self.0.len() as u64;
        let block = block(id, links, data);
        self.0.extend(block);
        address
    }

    fn text(&mut self, text: &str) -> u64 {
        self.block("TX", &[], format!("{text}\0").as_bytes())
    }

    /// A channel: the next one, its members, name, data; type, synchronisation, data type, first byte, bits.
    fn channel(&mut self, next: u64, members: u64, name: &str, data: u64, fields: [u32; 5]) -> u64 {
        let name = self.text(name);
        let [kind, sync, data_type, byte, bits] = fields;
        let mut body = vec![kind as u8, sync as u8, data_type as u8, 0];
        for number in [byte, bits, 0, 0] {
            body.extend(number.to_le_bytes());
        }
        body.resize(72, 0);
        self.block("CN", &[next, members, name, 0, 0, data, 0, 0], &body)
    }

    /// A group: the next one, its first channel; record identifier, records, flags, bytes.
    fn group(&mut self, next: u64, first: u64, fields: [u64; 4]) -> u64 {
        let [id, records, flags, bytes] = fields;
        let mut body = Vec::new();
        body.extend(id.to_le_bytes());
        body.extend(records.to_le_bytes());
        body.extend((flags as u16).to_le_bytes());
        body.extend([0; 6]);
        body.extend((bytes as u32).to_le_bytes());
        body.extend([0; 4]);
        self.block("CG", &[next, first, 0, 0, 0, 0], &body)
    }

    fn finish(mut self, data_group: u64) -> Vec<u8> {
        let header = block("HD", &[data_group, 0, 0, 0, 0, 0], &[0; 32]);
        self.0[64..64 + header.len()].copy_from_slice(&header);
        self.0
    }
}

fn block(id: &str, links: &[u64], data: &[u8]) -> Vec<u8> {
    let length = 24 + 8 * links.len() + data.len();
    let mut block = format!("##{id}\0\0\0\0").into_bytes();
    block.extend((length as u64).to_le_bytes());
    block.extend((links.len() as u64).to_le_bytes());
    for link in links {
        block.extend(link.to_le_bytes());
    }
    block.extend(data);
    block
}

const FIXED: u32 = 0;
const VARIABLE: u32 = 1;
const MASTER: u32 = 2;
const UNSIGNED: u32 = 0;
const FLOAT: u32 = 4;
const BYTES: u32 = 10;

/// What CAN FD can carry.
const LONG: [u8; 64] = [0xA5; 64];

/// Logged frames whose data stand in a group of values of variable length, their records mixed with those of measured
/// voltages, as the loggers on a vehicle write them.
fn mixed() -> Vec<u8> {
    let mut maker = Maker::new();
    let values = maker.group(0, 0, [2, 4, 1, 0]);

    let data = maker.channel(
        0,
        0,
        "CAN_DataFrame.DataBytes",
        values,
        [VARIABLE, 0, BYTES, 12, 64],
    );
    let length = maker.channel(
        data,
        0,
        "CAN_DataFrame.DataLength",
        0,
        [FIXED, 0, UNSIGNED, 11, 8],
    );
    let ide = maker.channel(
        length,
        0,
        "CAN_DataFrame.IDE",
        0,
        [FIXED, 0, UNSIGNED, 10, 8],
    );
    let id = maker.channel(ide, 0, "CAN_DataFrame.ID", 0, [FIXED, 0, UNSIGNED, 8, 16]);
    let frame = maker.channel(0, id, "CAN_DataFrame", 0, [FIXED, 0, BYTES, 8, 96]);
    let time = maker.channel(frame, 0, "Timestamp", 0, [MASTER, 1, FLOAT, 0, 64]);
    let frames = maker.group(values, time, [1, 4, 2, 20]);

    let voltage = maker.channel(0, 0, "v_cell_v", 0, [FIXED, 0, FLOAT, 8, 32]);
    let time = maker.channel(voltage, 0, "t", 0, [MASTER, 1, FLOAT, 0, 64]);
    let measured = maker.group(frames, time, [7, 2, 0, 12]);

    let mut records = Vec::new();
    let mut offset = 0_u64;
    let mut frame = |records: &mut Vec<u8>, time_s: f64, id: u16, ide: u8, data: &[u8]| {
        records.push(1);
        records.extend(time_s.to_le_bytes());
        records.extend(id.to_le_bytes());
        records.extend([ide, data.len() as u8]);
        records.extend(offset.to_le_bytes());
        records.push(2);
        records.extend((data.len() as u32).to_le_bytes());
        records.extend(data);
        offset += 4 + data.len() as u64;
    };
    let voltage = |records: &mut Vec<u8>, time_s: f64, voltage_v: f32| {
        records.push(7);
        records.extend(time_s.to_le_bytes());
        records.extend(voltage_v.to_le_bytes());
    };
    frame(&mut records, 0.25, 0x123, 0, &[1, 2, 3]);
    voltage(&mut records, 0.5, 3.5);
    frame(&mut records, 0.5, 0x123, 1, &[]);
    frame(&mut records, 0.75, 0x7FF, 0, &[1, 2, 3, 4, 5, 6, 7, 8]);
    frame(&mut records, 1.0, 0x7FF, 0, &LONG);
    voltage(&mut records, 1.5, 3.25);

    let data = maker.block("DT", &[], &records);
    let data_group = maker.block("DG", &[0, measured, data, 0], &[1, 0, 0, 0, 0, 0, 0, 0]);
    maker.finish(data_group)
}

#[test]
fn mixed_groups_and_values_of_variable_length() {
    let contents = mdf::read("m.mf4", None, &mixed()).unwrap();
    let mut frames = Vec::new();
    contents
        .frames
        .give(&mut |frame: &Frame<'_>| {
            let data = frame.data[..frame.length].to_vec();
            frames.push((frame.time_ns, frame.id, frame.extended, data));
            Ok(())
        })
        .unwrap();
    assert_eq!(
        frames,
        [
            (250_000_000, 0x123, false, vec![1, 2, 3]),
            (500_000_000, 0x123, true, vec![]),
            (750_000_000, 0x7FF, false, vec![1, 2, 3, 4, 5, 6, 7, 8]),
            (1_000_000_000, 0x7FF, false, LONG.to_vec()),
        ]
    );
    assert_eq!((contents.counts.frames, contents.counts.fd), (4, 1));
    assert_eq!(contents.series.len(), 1);
    assert_eq!(contents.series[0].time_s, [0.5, 1.5]);
    assert_eq!(contents.series[0].signals[0].name, "v_cell_v");
    assert_eq!(contents.series[0].signals[0].values, [3.5, 3.25]);
}

/// Where a text of the file is, and where the body of the channel that it names: the block after it.
fn named(file: &[u8], name: &str) -> (usize, usize) {
    let find = |what: &[u8], from: usize| {
        let found = file[from..].windows(what.len()).position(|at| at == what);
        from + found.unwrap()
    };
    let text = find(format!("{name}\0").as_bytes(), 64);
    (text, find(b"##CN", text) + 24 + 8 * 8)
}

/// Longer than any number, with a bit offset beside which its length does not fit 32 bits.
#[test]
fn the_parts_of_a_logged_frame_are_numbers() {
    for (part, bits) in [
        ("ID", u32::MAX),
        ("IDE", 65),
        ("DataLength", 0),
        ("DataBytes", u32::MAX),
    ] {
        let mut file = mixed();
        let name = format!("CAN_DataFrame.{part}");
        let (_, channel) = named(&file, &name);
        file[channel + 3] = 7;
        file[channel + 8..channel + 12].copy_from_slice(&bits.to_le_bytes());
        let error = mdf::read("m.mf4", None, &file).unwrap_err();
        assert_eq!(error.kind(), Kind::Format);
        let expected = format!(": found \"{name}\" of {bits} bits, expected 1 to 64");
        assert!(error.to_string().ends_with(&expected), "{error}");
    }
}

/// Bits of a number anywhere in a record, and a name that two groups share.
fn measured(byte: u32, bit: u8, bits: u32, data_type: u32, records: &[[u8; 20]]) -> Vec<u8> {
    let mut maker = Maker::new();
    let mut next = 0;
    for _ in 0..2 {
        let channel = maker.channel(0, 0, "x", 0, [FIXED, 0, data_type, byte, bits]);
        maker.0[channel as usize + 24 + 64 + 3] = bit;
        let time = maker.channel(channel, 0, "t", 0, [MASTER, 1, FLOAT, 0, 64]);
        let group = maker.group(0, time, [0, records.len() as u64, 0, 20]);
        let data = maker.block("DT", &[], &records.concat());
        next = maker.block("DG", &[next, group, data, 0], &[0; 8]);
    }
    maker.finish(next)
}

#[test]
fn groups_tell_equal_names_apart() {
    let contents = mdf::read("m.mf4", None, &measured(8, 0, 8, UNSIGNED, &[[0; 20]])).unwrap();
    let names: Vec<_> = contents
        .series
        .iter()
        .map(|series| &series.signals[0].name)
        .collect();
    assert_eq!(names, ["group 1.x", "group 2.x"]);
}

#[test]
fn an_infinite_value_is_no_value_of_a_recording() {
    let mut records = [[0; 20]; 3];
    for (record, value) in records.iter_mut().zip([1.0, f32::NAN, f32::INFINITY]) {
        record[8..12].copy_from_slice(&value.to_le_bytes());
    }
    let contents = mdf::read("m.mf4", None, &measured(8, 0, 32, FLOAT, &records)).unwrap();
    let why = "x (an infinite value in record 3)";
    assert_eq!(contents.left_out, [why, why]);
    // What is not a number is missing.
    let contents = mdf::read("m.mf4", None, &measured(8, 0, 32, FLOAT, &records[..2])).unwrap();
    assert!(contents.series[0].signals[0].values[1].is_nan());
}

#[test]
fn a_channel_without_a_name_is_left_out() {
    let mut file = measured(8, 0, 8, UNSIGNED, &[[0; 20]]);
    let (name, _) = named(&file, "x");
    file[name] = 0;
    let contents = mdf::read("m.mf4", None, &file).unwrap();
    assert_eq!(contents.left_out, ["a channel of group (no name)"]);
    assert_eq!(contents.series[0].signals[0].name, "x");
}

#[test]
fn what_is_not_read_is_said() {
    let cases: [(Vec<u8>, Kind, &str); 6] = [
        (
            b"MDF".to_vec(),
            Kind::Format,
            "m.mf4, byte 0: found another kind of file, expected an MDF file",
        ),
        (
            b"MDF     3.30    ".to_vec(),
            Kind::Unsupported,
            "m.mf4, byte 8: found version \"3.30\", expected version 4",
        ),
        (
            b"UnFinMF 4.10    ".to_vec(),
            Kind::Unsupported,
            "m.mf4, byte 0: found a measurement that was not ended, expected a finished file",
        ),
        (
            mixed()[..64].to_vec(),
            Kind::Format,
            "m.mf4, byte 64: found no block, expected a block of the file",
        ),
        (
            // Two records promised, one there.
            {
                let mut file = measured(8, 0, 8, UNSIGNED, &[[0; 20], [0; 20]]);
                let data = file.windows(4).rposition(|bytes| bytes == b"##DT").unwrap();
                file[data + 8] -= 20;
                file
            },
            Kind::Format,
            "found data of 1 records, expected 2 as its group says",
        ),
        (
            {
                let mut file = measured(8, 0, 8, UNSIGNED, &[[0; 20]]);
                let data = file.windows(4).rposition(|bytes| bytes == b"##DT").unwrap();
                file[data + 2..data + 4].copy_from_slice(b"LD");
                file
            },
            Kind::Unsupported,
            "found data in a block \"LD\", expected DT, SD, DZ, DL or HL",
        ),
    ];
    for (file, kind, sentence) in cases {
        let error = mdf::read("m.mf4", None, &file).unwrap_err();
        assert_eq!(error.kind(), kind);
        assert!(error.to_string().ends_with(sentence), "{error}");
    }
}

/// Each level of compositions links the whole level below from each of its channels: 8^9 channels in 12 kB.
#[test]
fn channels_that_share_their_members_are_damage() {
    let mut maker = Maker::new();
    let mut members = 0;
    for _ in 0..9 {
        let mut next = 0;
        for _ in 0..8 {
            next = maker.channel(next, members, "", 0, [FIXED, 0, UNSIGNED, 0, 8]);
        }
        members = next;
    }
    let group = maker.group(0, members, [0, 1, 0, 8]);
    let data = maker.block("DT", &[], &[0; 8]);
    let data_group = maker.block("DG", &[0, group, data, 0], &[0; 8]);
    let error = mdf::read("m.mf4", None, &maker.finish(data_group)).unwrap_err();
    assert!(
        error
            .to_string()
            .ends_with("found channels that are linked again and again, expected each once"),
        "{error}"
    );
}

#[test]
fn data_that_is_listed_twice_is_damage() {
    let mut maker = Maker::new();
    let time = maker.channel(0, 0, "t", 0, [MASTER, 1, FLOAT, 0, 64]);
    let group = maker.group(0, time, [0, 2, 0, 8]);
    let data = maker.block("DT", &[], &[0; 8]);
    let list = maker.block("DL", &[0, data, data], &[0; 16]);
    let data_group = maker.block("DG", &[0, group, list, 0], &[0; 8]);
    let error = mdf::read("m.mf4", None, &maker.finish(data_group)).unwrap_err();
    assert!(
        error
            .to_string()
            .ends_with("found a block twice in a list of data, expected each block once"),
        "{error}"
    );
}

/// In ns they would all be the same.
#[test]
fn times_are_of_less_than_292_years() {
    let mut records = [[0; 20]; 2];
    records[1][..8].copy_from_slice(&1e10_f64.to_le_bytes());
    let error = mdf::read("m.mf4", None, &measured(8, 0, 8, UNSIGNED, &records)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "m.mf4, row 2, column group: t: found 10000000000 s, expected a time of less than 292 years"
    );
}

fn linked_again(file: &[u8]) {
    let error = mdf::read("m.mf4", None, file).unwrap_err();
    assert!(
        error
            .to_string()
            .ends_with("found data that are linked again and again, expected each once"),
        "{error}"
    );
}

/// Each block of a list reaches to the end of the last one: 50 MB in 64 kB, and 5 GB in ten times that.
#[test]
fn data_blocks_inside_of_each_other_are_damage() {
    const BLOCKS: u64 = 2_000;
    let mut maker = Maker::new();
    let time = maker.channel(0, 0, "t", 0, [MASTER, 1, FLOAT, 0, 64]);
    let group = maker.group(0, time, [0, 2, 0, 8]);
    let blocks: Vec<u64> = (0..BLOCKS)
        .map(|block| {
            let inside = vec![0; 24 * (BLOCKS - 1 - block) as usize];
            let address = maker.block("DT", &[], &inside);
            maker.0.truncate(address as usize + 24);
            address
        })
        .collect();
    let links = [vec![0], blocks].concat();
    let list = maker.block("DL", &links, &[0; 16]);
    let data_group = maker.block("DG", &[0, group, list, 0], &[0; 8]);
    linked_again(&maker.finish(data_group));
}

#[test]
fn data_that_many_groups_share_are_damage() {
    let mut maker = Maker::new();
    let time = maker.channel(0, 0, "t", 0, [MASTER, 1, FLOAT, 0, 64]);
    let group = maker.group(0, time, [0, 2, 0, 8]);
    let data = maker.block("DT", &[], &[0; 10_000]);
    let mut next = 0;
    for _ in 0..3 {
        next = maker.block("DG", &[next, group, data, 0], &[0; 8]);
    }
    linked_again(&maker.finish(next));
}

#[test]
fn time_must_not_run_backwards() {
    let mut records = [[0; 20]; 2];
    records[0][..8].copy_from_slice(&2.0_f64.to_le_bytes());
    records[1][..8].copy_from_slice(&1.0_f64.to_le_bytes());
    let error = mdf::read("m.mf4", None, &measured(8, 0, 8, UNSIGNED, &records)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "m.mf4, row 2, column group: t: found 1 s, expected a time not before the last record's 2 s"
    );
}

proptest! {
    /// Intel: bit `n` of the number is bit `n` from the first byte on. Motorola: the bytes in the other order.
    #[test]
    fn numbers_stand_at_any_bit(
        rest: [u8; 11],
        byte in 8_u32..12,
        bit in 0_u8..8,
        bits in 1_u32..=56,
        motorola: bool,
        signed: bool,
    ) {
        let mut record = [0; 20];
        record[8..19].copy_from_slice(&rest);
        let data_type = u32::from(motorola) + 2 * u32::from(signed);
        let contents = mdf::read("m.mf4", None, &measured(byte, bit, bits, data_type, &[record])).unwrap();
        let length = (u32::from(bit) + bits).div_ceil(8) as usize;
        let mut bytes = record[byte as usize..byte as usize + length].to_vec();
        if motorola {
            bytes.reverse();
        }
        let mut expected = 0_i64;
        for index in 0..bits {
            let at = u32::from(bit) + index;
            expected |= i64::from(bytes[at as usize / 8] >> (at % 8) & 1) << index;
        }
        if signed && expected >> (bits - 1) & 1 != 0 {
            expected -= 1 << bits;
        }
        prop_assert_eq!(contents.series[0].signals[0].values[0], expected as f64);
    }

    #[test]
    fn damage_makes_no_panic(
        damage in prop::collection::vec((0_usize..4000, prop_oneof![any::<u8>(), Just(0), Just(255)]), 1..6),
        length in 0_usize..4000,
        cut: bool,
        second: bool,
    ) {
        let mut file = if second { measured(8, 3, 40, 1, &[[7; 20]; 3]) } else { mixed() };
        for (place, byte) in damage {
            let place = place % file.len();
            file[place] = byte;
        }
        if cut {
            file.truncate(length);
        }
        match mdf::read("m.mf4", None, &file) {
            Ok(contents) => {
                for series in contents.series {
                    for signal in series.signals {
                        prop_assert_eq!(signal.values.len(), series.time_s.len());
                    }
                }
            }
            Err(error) => {
                prop_assert!(error.place().row.is_some() || error.place().offset.is_some(), "{}", error);
            }
        }
    }
}
