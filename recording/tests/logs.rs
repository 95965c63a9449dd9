//! Logs of CAN frames and the database that decodes them, case by case.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::io::Write;

use core_logic::e2e;
use flate2::{Compression, write::ZlibEncoder};
use proptest::prelude::*;
use recording::{
    Error, Mapping, Recording,
    dbc::{Database, Decoded, Decoder},
    error::Kind,
    log::{self, Counts, DATA_BYTES, Frame},
    merge::Merged,
};

type Reader = fn(&str, Option<&str>, &[u8], &mut log::Sink<'_>) -> Result<Counts, Error>;

const READERS: [Reader; 3] = [
    |source, bus, bytes, sink| log::candump::read(source, bus, bytes, sink),
    |source, bus, bytes, sink| log::asc::read(source, bus, bytes, sink),
    |source, bus, bytes, sink| log::blf::read(source, bus, bytes, sink),
];
const CANDUMP: Reader = READERS[0];
const ASC: Reader = READERS[1];
const BLF: Reader = READERS[2];

/// A frame as a test writes it: time in ns, bus, identifier (negative: 29 bits), data.
type Plain = (i64, String, i64, Vec<u8>);

fn read(reader: Reader, bytes: &[u8]) -> Result<(Vec<Plain>, Counts), Error> {
    read_bus(reader, None, bytes)
}

fn read_bus(
    reader: Reader,
    bus: Option<&str>,
    bytes: &[u8],
) -> Result<(Vec<Plain>, Counts), Error> {
    let mut frames = Vec::new();
    let counts = reader("log", bus, bytes, &mut |frame| {
        let id = i64::from(frame.id) * if frame.extended { -1 } else { 1 };
        assert!(frame.data[frame.length..].iter().all(|&byte| byte == 0));
        let data = frame.data[..frame.length].to_vec();
        frames.push((frame.time_ns, frame.bus.to_owned(), id, data));
        Ok(())
    })?;
    Ok((frames, counts))
}

fn plain(time_ns: i64, bus: &str, id: i64, data: &[u8]) -> Plain {
    (time_ns, bus.to_owned(), id, data.to_vec())
}

#[test]
fn candump_lines() {
    let log = "(1436509052.249713) vcan0 044#2A366C2BBA\n\
        (1436509053.850870) can1 00000001#\n\
        \n\
        (1436509053.9) can1 7FF#R4\r\n\
        (1436509053.95) can1 20000080#0000000000000000\n\
        (1436509054.000000001) can1 1FFFFFFF#01.02.03 T\n\
        (1436509054.1) can1 123#1122334455667788_B R\n";
    let (frames, counts) = read(CANDUMP, log.as_bytes()).unwrap();
    assert_eq!(
        frames,
        [
            plain(
                1_436_509_052_249_713_000,
                "vcan0",
                0x44,
                &[0x2A, 0x36, 0x6C, 0x2B, 0xBA]
            ),
            plain(1_436_509_053_850_870_000, "can1", -1, &[]),
            plain(1_436_509_054_000_000_001, "can1", -0x1FFF_FFFF, &[1, 2, 3]),
            plain(
                1_436_509_054_100_000_000,
                "can1",
                0x123,
                &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]
            ),
        ]
    );
    assert_eq!((counts.frames, counts.remote, counts.errors), (4, 1, 1));
}

#[test]
fn a_candump_log_that_is_cut_loses_its_last_line() {
    let log = "(1.0) can0 123#0102\n(1.1) can0 123#0304";
    // Wherever it was cut, of the second frame nothing is made up.
    for length in "(1.0) can0 123#0102\n(".len()..=log.len() {
        let (frames, counts) = read(CANDUMP, &log.as_bytes()[..length]).unwrap();
        assert_eq!(frames, [plain(1_000_000_000, "can0", 0x123, &[1, 2])]);
        assert_eq!((counts.frames, counts.cut), (1, 1));
    }
    let (frames, counts) = read(CANDUMP, format!("{log}\n").as_bytes()).unwrap();
    assert_eq!((frames.len(), counts.cut), (2, 0));
}

#[test]
fn a_vector_ascii_log_that_is_cut_loses_its_last_line() {
    let first = "base hex timestamps absolute\n0.5 1 123 Rx d 2 01 02\n";
    for second in [
        "  1.25 1 123 Rx d 2 03 04",
        "  1.25 CANFD 1 Rx 123 Name 1 0 2 2 03 04 100 130 3000 46 8",
    ] {
        let log = format!("{first}{second}");
        for length in first.len() + 3..=log.len() {
            let (frames, counts) = read(ASC, &log.as_bytes()[..length]).unwrap();
            assert_eq!(frames, [plain(500_000_000, "1", 0x123, &[1, 2])]);
            assert_eq!((counts.frames, counts.cut), (1, 1), "{length}");
        }
        let (frames, counts) = read(ASC, format!("{log}\n").as_bytes()).unwrap();
        assert_eq!((frames.len(), counts.cut), (2, 0));
    }
    // The end of the last block is none of its events.
    let log = format!("{first}End TriggerBlock");
    let (frames, counts) = read(ASC, log.as_bytes()).unwrap();
    assert_eq!((frames.len(), counts.cut), (1, 0));
}

#[test]
fn candump_faults_have_their_place() {
    let cases = [
        (
            "x",
            "log, line 1, column 1: found \"x\", expected a time such as (1436509052.249713)",
        ),
        (
            "(1.0)",
            "log, line 1, column 2: found \"\", expected an interface such as can0",
        ),
        (
            "\n(1.0) can0 123",
            "log, line 2, column 3: found \"123\", expected a frame such as 123#DEADBEEF",
        ),
        (
            "(1.0) can0 123##",
            "log, line 1, column 3: found \"123##\", expected a digit of flags and up to 64 bytes of two hexadecimal digits after ##",
        ),
        (
            "(1.0) can0 123##1A",
            "log, line 1, column 3: found \"123##1A\", expected a digit of flags and up to 64 bytes of two hexadecimal digits after ##",
        ),
        (
            "(1.0) can0 1234#00",
            "log, line 1, column 3: found \"1234#00\", expected an identifier of 3 or 8 hexadecimal digits",
        ),
        (
            "(1.0) can0 +12#00",
            "log, line 1, column 3: found \"+12#00\", expected an identifier of 3 or 8 hexadecimal digits",
        ),
        (
            "(1.0) can0 800#00",
            "log, line 1, column 3: found \"800#00\", expected an identifier of 11 or 29 bits",
        ),
        (
            "(1.0) can0 123#0",
            "log, line 1, column 3: found \"123#0\", expected up to eight bytes of two hexadecimal digits after #",
        ),
        (
            "(1.0) can0 123#00112233445566778899",
            "log, line 1, column 3: found \"123#00112233445566778899\", expected up to eight bytes of two hexadecimal digits after #",
        ),
        (
            "(1.0) can0 123#00 X",
            "log, line 1, column 4: found \"X\", expected R, T or the end of the line",
        ),
    ];
    for (log, sentence) in cases {
        assert_eq!(
            read(CANDUMP, format!("{log}\n").as_bytes())
                .unwrap_err()
                .to_string(),
            sentence
        );
    }
}

const ASC_EVENTS: &str = "Begin Triggerblock Fri M\u{e4}r 1 10:00:00.000 am 2024
   0.000000 Start of measurement
   0.015991 CAN 1 Status:chip status error active
   0.500000 1  390x            Rx   d 3 16 17 99  Length = 256215 BitCount = 130 ID = 912
   0.750000 2  20              Tx   d 0
   1.000000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
   1.000000 1  ErrorFrame
   1.250000 1  20              TxRq d 1 01
   1.500000 1  20              Rx   r
// a comment
   2.000000 1  7               Rx   d 8 1 2 3 4 5 6 7 8
End TriggerBlock
";

#[test]
fn vector_ascii_in_either_base_and_either_time() {
    let data = [1, 2, 3, 4, 5, 6, 7, 8];
    let absolute = |base: u32| {
        let id = |text| i64::from_str_radix(text, base).unwrap();
        let byte = |text| u8::from_str_radix(text, base).unwrap();
        [
            plain(
                500_000_000,
                "1",
                -id("390"),
                &[byte("16"), byte("17"), byte("99")],
            ),
            plain(750_000_000, "2", id("20"), &[]),
            plain(2_000_000_000, "1", 7, &data),
        ]
    };
    for (header, base) in [
        ("base hex  timestamps absolute", 16),
        ("base dec timestamps absolute", 10),
    ] {
        let log = format!("date Fri Mar 1 2024\n{header}\nno internal events logged\n{ASC_EVENTS}");
        // The month of a German computer is not UTF-8.
        let bytes: Vec<u8> = log
            .chars()
            .map(|letter| u8::try_from(letter).unwrap())
            .collect();
        let (frames, counts) = read(ASC, &bytes).unwrap();
        assert_eq!(frames, absolute(base));
        assert_eq!((counts.remote, counts.errors, counts.others), (1, 1, 4));
    }
    // Each time counts from the line before, whatever that is.
    let log = format!("base hex timestamps relative\n{ASC_EVENTS}");
    let (frames, _) = read(ASC, log.as_bytes()).unwrap();
    let times: Vec<_> = frames.iter().map(|frame| frame.0).collect();
    let sums_ms = [516, 1266, 8016];
    assert!(
        times
            .iter()
            .zip(sums_ms)
            .all(|(ns, ms)| (ns + 500_000) / 1_000_000 == ms),
        "{times:?}"
    );
}

#[test]
fn vector_ascii_faults_have_their_place() {
    let cases = [
        (
            "",
            "log: found no header, expected \"base hex\" or \"base dec\" in one of the first lines",
        ),
        (
            "date x\n0.1 1 20 Rx d 0",
            "log, line 2: found \"0.1 1 20 Rx d 0\", expected a header with \"base hex\" or \"base dec\" before the first event",
        ),
        (
            "base hex\n0.x 1 20 Rx d 0",
            "log, line 2, column 1: found \"0.x\", expected a time in seconds",
        ),
        (
            "base hex\n0.1 1 800 Rx d 0",
            "log, line 2, column 3: found \"800\", expected an identifier of 11 bits, or of 29 and an x",
        ),
        (
            "base dec\n0.1 1 1FFx Rx d 0",
            "log, line 2, column 3: found \"1FFx\", expected an identifier of 11 bits, or of 29 and an x",
        ),
        (
            "base hex\n0.1 1 20 Rx q 0",
            "log, line 2, column 5: found \"q\", expected d for data or r for a remote frame",
        ),
        (
            "base hex\n0.1 1 20 Rx d 10",
            "log, line 2, column 6: found \"10\", expected a length code of 0 to 15",
        ),
        (
            "base hex\n0.1 1 20 Rx d 2 00 100",
            "log, line 2, column 8: found \"100\", expected a byte",
        ),
        (
            "base hex\n0.1 1 20 Rx d 2 00",
            "log, line 2, column 8: found \"\", expected a byte",
        ),
        (
            "base hex\n0.1 CANFD 1 Rx 20 1 0 9 12 00",
            "log, line 2, column 11: found \"\", expected a byte",
        ),
        (
            "base hex\n0.1 CANFD 1 Rx 20 Name 1 0 f 65 00",
            "log, line 2, column 10: found \"65\", expected a length of 0 to 64",
        ),
        (
            "base hex\n0.1 CANFD 1 Rx 20 Name x 0 f 64 00",
            "log, line 2, column 7: found \"x\", expected 0 or 1 for the bit rate switch",
        ),
    ];
    for (log, sentence) in cases {
        let log = format!("{log}\n");
        assert_eq!(read(ASC, log.as_bytes()).unwrap_err().to_string(), sentence);
    }
}

#[test]
fn vector_binary_faults_have_their_place() {
    let header = {
        let mut header = b"LOGG".to_vec();
        header.extend(144_u32.to_le_bytes());
        header.resize(144, 0);
        header
    };
    let object = |kind: u32, body: &[u8]| {
        let mut object = b"LOBJ".to_vec();
        object.extend([32, 0, 1, 0]);
        object.extend((32 + body.len() as u32).to_le_bytes());
        object.extend(kind.to_le_bytes());
        object.extend(2_u32.to_le_bytes());
        object.extend([0; 4]);
        object.extend(5_u64.to_le_bytes());
        object.extend(body);
        object
    };
    let log = |objects: &[u8]| [header.clone(), objects.to_vec()].concat();

    // Objects may stand outside of containers; data beyond the length code is left out.
    let message = [2, 0, 0, 3, 0x23, 1, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8];
    let (frames, _) = read(BLF, &log(&object(1, &message))).unwrap();
    assert_eq!(frames, [plain(5, "2", 0x123, &[1, 2, 3])]);

    // A classic frame in an object for CAN FD, and one that is not classic.
    let mut fd = vec![
        1, 0, 0, 2, 0x23, 1, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0xAA, 0xBB,
    ];
    fd.resize(84, 0);
    let (frames, _) = read(BLF, &log(&object(100, &fd))).unwrap();
    assert_eq!(frames, [plain(5, "1", 0x123, &[0xAA, 0xBB])]);
    fd[13] = 1;
    fd[14] = 64;
    fd[83] = 0xCC;
    let (frames, counts) = read(BLF, &log(&object(100, &fd))).unwrap();
    assert_eq!(frames, [plain(5, "1", 0x123, &fd[20..84])]);
    assert_eq!((counts.frames, counts.fd), (1, 1));

    // A remote frame and an error frame on the bus 2, another error frame on the bus 1.
    let remote = [2, 0, 0x80, 3, 0x23, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    let objects = [
        object(1, &remote),
        object(2, &[2, 0, 0, 0, 0, 0, 0, 0]),
        object(104, &[1; 44]),
    ]
    .concat();
    for (bus, counted) in [(None, (2, 1)), (Some("1"), (1, 0)), (Some("2"), (1, 1))] {
        let (_, counts) = read_bus(BLF, bus, &log(&objects)).unwrap();
        assert_eq!((counts.errors, counts.remote), counted);
    }

    let whole = log(&object(1, &message));
    // Wherever it is cut, of the second frame nothing is made up.
    let two = log(&[object(1, &message), object(1, &message)].concat());
    for length in whole.len() + 1..two.len() {
        let (frames, counts) = read(BLF, &two[..length]).unwrap();
        assert_eq!(frames, [plain(5, "2", 0x123, &[1, 2, 3])]);
        assert_eq!((counts.frames, counts.cut), (1, 1), "{length}");
    }
    // Nor where an object ends beyond its container, and the next one is not there.
    let packed = |inside: &[u8]| {
        let mut container = b"LOBJ".to_vec();
        container.extend([16, 0, 1, 0]);
        container.extend((32 + inside.len() as u32).to_le_bytes());
        container.extend(10_u32.to_le_bytes());
        container.extend([0; 16]);
        container.extend(inside);
        container
    };
    let mut inside = object(1, &message);
    inside.extend(&object(1, &message)[..30]);
    let (frames, counts) = read(BLF, &log(&packed(&inside))).unwrap();
    assert_eq!((frames.len(), counts.cut), (1, 1));
    // Of a container that is cut, what is whole, packed or not.
    let inside = object(1, &message).repeat(50);
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::none());
    encoder.write_all(&inside).unwrap();
    let packed = object(
        10,
        &[
            &[2, 0, 0, 0, 0, 0, 0, 0][..],
            &(inside.len() as u32).to_le_bytes(),
            &[0; 4],
            &encoder.finish().unwrap(),
        ]
        .concat(),
    );
    // A container's header is shorter than that of other objects by 16 bytes.
    let packed = log(&[
        &packed[..4],
        &[16, 0, 1, 0],
        &((packed.len() - 16) as u32).to_le_bytes(),
        &packed[12..16],
        &packed[32..],
    ]
    .concat());
    assert_eq!(read(BLF, &packed).unwrap().0.len(), 50);
    let mut most = 0;
    for length in 145..packed.len() {
        let (frames, counts) = read(BLF, &packed[..length]).unwrap();
        assert!(
            frames
                .iter()
                .all(|frame| *frame == plain(5, "2", 0x123, &[1, 2, 3]))
        );
        assert!(frames.len() >= most && counts.cut == 1, "{length}");
        most = frames.len();
    }
    assert!(most >= 49, "{most}");

    for (bytes, sentence) in [
        (
            b"LOBJ".to_vec(),
            "log, byte 0: found another kind of file, expected a BLF file, beginning with LOGG",
        ),
        (
            whole[..100].to_vec(),
            "log, byte 4: found a header of 144 bytes, expected one that fits the file",
        ),
        (
            log(b"LOBX"),
            "log, byte 144: found no object, expected an object that begins with LOBJ",
        ),
        (
            log(&object(
                10,
                &[2, 0, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3],
            )),
            "log, byte 144: found \"corrupt deflate stream\", expected a container packed by zlib",
        ),
    ] {
        assert_eq!(read(BLF, &bytes).unwrap_err().to_string(), sentence);
    }
}

/// An object of 16 MiB that never ends, then 20,000 containers of four bytes: copied for each of them it was 320 GB.
#[test]
fn a_long_object_in_small_pieces_is_not_copied_for_each() {
    const LENGTH: u32 = 1 << 24;
    let container = |packed: &[u8], length: u32, method: u16| {
        let mut object = b"LOBJ".to_vec();
        object.extend([16, 0, 1, 0]);
        object.extend((32 + packed.len() as u32).to_le_bytes());
        object.extend(10_u32.to_le_bytes());
        object.extend(method.to_le_bytes());
        object.extend([0; 6]);
        object.extend(length.to_le_bytes());
        object.extend([0; 4]);
        object.extend(packed);
        object.resize(object.len() + packed.len() % 4, 0);
        object
    };
    let mut long = b"LOBJ".to_vec();
    long.extend([32, 0, 1, 0]);
    long.extend((2 * LENGTH).to_le_bytes());
    long.resize(LENGTH as usize, 0);
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(&long).unwrap();
    let mut log = b"LOGG".to_vec();
    log.extend(144_u32.to_le_bytes());
    log.resize(144, 0);
    log.extend(container(&encoder.finish().unwrap(), LENGTH, 2));
    for _ in 0..20_000 {
        log.extend(container(&[0; 4], 4, 0));
    }
    let (frames, counts) = read(BLF, &log).unwrap();
    assert_eq!((frames.len(), counts.cut), (0, 1));
}

#[test]
fn frames_of_can_fd_have_up_to_64_bytes() {
    let bytes: Vec<u8> = (0..64).collect();
    let hex = |join: &str| {
        let digits: Vec<String> = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
        digits.join(join)
    };
    let log = format!(
        "(1.5) can0 123##1{}\n(1.6) can0 12345678##0\n(1.7) can0 123##5AA.BB\n",
        hex("")
    );
    let (frames, counts) = read(CANDUMP, log.as_bytes()).unwrap();
    let expected = |bus: &str| {
        [
            plain(1_500_000_000, bus, 0x123, &bytes),
            plain(1_600_000_000, bus, -0x1234_5678, &[]),
            plain(1_700_000_000, bus, 0x123, &[0xAA, 0xBB]),
        ]
    };
    assert_eq!(frames, expected("can0"));
    assert_eq!((counts.frames, counts.fd), (3, 3));

    let tail = "0 0 1000 0 0 0 0 0";
    let log = format!(
        "base hex timestamps absolute\n1.5 CANFD 1 Rx 123 Shunt 1 0 f 64 {} {tail}\n\
         1.6 CANFD 1 Tx 12345678x 0 0 0 0 {tail}\n1.7 CANFD 1 Rx 123 1 0 2 2 AA BB\n\
         1.8 CANFD 1 Rx 123 0 0 2 0 0 0 10 0\n1.9 CANFD 1 Rx ErrorFrame\n",
        hex(" ")
    );
    let (frames, counts) = read(ASC, log.as_bytes()).unwrap();
    assert_eq!(frames, expected("1"));
    assert_eq!(
        (counts.frames, counts.fd, counts.remote, counts.errors),
        (3, 3, 1, 1)
    );
}

const DATABASE: &str = r#"VERSION ""

NS_ :

BS_:

BU_: A

BO_ 16 Shunt: 8 A
 SG_ Current : 0|16@1- (1,0) [0|0] "mA" A
 SG_ Page M : 16|8@1+ (1,0) [0|0] "" A
 SG_ Volt m1 : 24|16@1+ (0.001,0) [0|0] "V" A
 SG_ Temp m2 : 24|8@1+ (1,-40) [0|0] "degC" A

BO_ 17 Other: 8 A
 SG_ Level : 7|8@0+ (0.5,0) [0|0] "%" A
"#;

fn decode_with(
    database: &str,
    log: &str,
    bus: Option<&str>,
) -> Result<(Recording, Decoded), Error> {
    let database = Database::parse("v.dbc", database.as_bytes())?;
    let mut decoder = Decoder::new(&database, "log", bus, true);
    log::candump::read("log", None, log.as_bytes(), &mut |frame: &Frame<'_>| {
        decoder.frame(frame)
    })?;
    let (series, decoded) = decoder.finish().unwrap();
    Ok((Merged::new("log", series)?.recording()?, decoded))
}

fn decode(log: &str) -> Result<(Recording, Decoded), Error> {
    decode_with(DATABASE, log, None)
}

/// Missing values as -1, so that they can be compared.
fn column(recording: &Recording, name: &str) -> Vec<f64> {
    let values = recording.need(name).unwrap().iter();
    values
        .map(|value| if value.is_nan() { -1.0 } else { *value })
        .collect()
}

#[test]
fn rows_are_the_times_of_all_messages_and_nothing_is_filled() {
    let (read, decoded) = decode(
        "(1700000000.000001) can0 010#E803010810\n\
         (1700000000.100001) can0 011#14\n\
         (1700000000.200001) can0 010#18FC0250\n\
         (1700000000.200001) can0 011#15\n\
         (1700000000.200001) can0 011#16\n\
         (1700000000.300001) can0 010#0000070000\n\
         (1700000000.400001) can0 7FF#00\n\
         (1700000000.500001) can0 010#0100\n",
    )
    .unwrap();
    assert_eq!(read.time_s(), [0.0, 0.1, 0.2, 0.2, 0.3, 0.5]);
    assert_eq!(
        column(&read, "Shunt.Current_a"),
        [1.0, -1.0, -1.0, -1.0, 0.0, 0.001]
    );
    assert_eq!(
        read.need("Shunt.Current_a").unwrap()[2],
        -1.0,
        "measured, not missing"
    );
    assert_eq!(
        column(&read, "Shunt.Page"),
        [1.0, -1.0, 2.0, -1.0, 7.0, -1.0]
    );
    assert_eq!(
        column(&read, "Shunt.Volt_v"),
        [4.104, -1.0, -1.0, -1.0, -1.0, -1.0]
    );
    assert_eq!(
        column(&read, "Shunt.Temp_c"),
        [-1.0, -1.0, 40.0, -1.0, -1.0, -1.0]
    );
    assert_eq!(
        column(&read, "Other.Level_pct"),
        [-1.0, 10.0, 10.5, 11.0, -1.0, -1.0]
    );
    assert_eq!((decoded.frames, decoded.unknown, decoded.short), (7, 1, 1));
}

#[test]
fn small_disorder_is_put_right_and_a_set_clock_is_refused() {
    let (read, decoded) = decode(
        "(10.0) can0 010#0100\n(10.5) can0 010#0200\n(10.25) can0 010#0300\n(10.25) can0 010#0400\n",
    )
    .unwrap();
    assert_eq!(read.time_s(), [0.0, 0.25, 0.25, 0.5]);
    assert_eq!(
        column(&read, "Shunt.Current_a"),
        [0.001, 0.003, 0.004, 0.002]
    );
    assert_eq!(decoded.disordered, 2);
    let error = decode("(10.0) can0 010#0100\n(8.5) can0 010#0200\n").unwrap_err();
    assert_eq!(error.kind(), Kind::TimeBackwards);
    assert_eq!(
        error.to_string(),
        "log, line 2: found -1.5 s, expected a time not more than 1 s before the last one, 0 s"
    );
}

#[test]
fn what_another_bus_carries_is_not_counted() {
    let told = |reader, bus, log: &str| {
        let (frames, counts) = read_bus(reader, bus, log.as_bytes()).unwrap();
        assert_eq!(frames.len(), 3);
        (counts.errors, counts.remote, counts.fd, counts.others)
    };
    let log = "(1.0) can0 123#01\n(1.1) can1 123##001\n(1.2) can1 20000080#\n(1.3) can0 123#R\n(1.4) can1 123#02\n";
    assert_eq!(told(CANDUMP, None, log), (1, 1, 1, 0));
    assert_eq!(told(CANDUMP, Some("can0"), log), (0, 1, 0, 0));
    assert_eq!(told(CANDUMP, Some("can1"), log), (1, 0, 1, 0));
    let log = "base hex timestamps absolute\n0.0 Start of measurement\n1.0 1 123 Rx d 1 01\n\
        1.1 CANFD 2 Rx 123 1 0 1 1 02 0 0 1000\n1.2 2 ErrorFrame\n1.3 1 123 Rx r\n\
        1.4 2 Statistic: D 0\n1.5 2 123 Rx d 1 03\n";
    assert_eq!(told(ASC, None, log), (1, 1, 1, 2));
    assert_eq!(told(ASC, Some("1"), log), (0, 1, 0, 1));
    assert_eq!(told(ASC, Some("2"), log), (1, 0, 1, 2));
}

#[test]
fn of_two_buses_one_must_be_chosen() {
    let log = "(1.0) can0 010#0100\n(1.1) can1 010#0200\n";
    let error = decode(log).unwrap_err();
    assert_eq!(
        error.to_string(),
        "log, line 2: found the identifier 0x10 on \"can1\" after \"can0\", expected it on one bus, or the bus to be chosen"
    );
    let (read, _) = decode_with(DATABASE, log, Some("can1")).unwrap();
    assert_eq!(column(&read, "Shunt.Current_a"), [0.002]);
    // Another bus may do what it likes: CAN FD, and a clock that was set.
    let log = "(9.0) can0 010##1000102030405060708090A0B\n(1.1) can1 010#0200\n";
    let (read, decoded) = decode_with(DATABASE, log, Some("can1")).unwrap();
    assert_eq!(column(&read, "Shunt.Current_a"), [0.002]);
    assert_eq!((decoded.frames, decoded.unknown), (1, 0));
}

const BOARD: &str = include_str!("../../can/board.dbc");

/// A frame of the board's database, signals as (first bit, value), protected as the board does it.
fn board_frame(id: u16, counter: u8, signals: &[(u32, u64)]) -> String {
    let word = signals
        .iter()
        .fold(0, |word, (start, value)| word | value << start);
    let mut payload = word.to_le_bytes();
    e2e::protect(e2e::DataId::new(id), counter, &mut payload);
    hex(id, &payload)
}

fn hex(id: u16, payload: &[u8]) -> String {
    let digits: String = payload.iter().map(|byte| format!("{byte:02X}")).collect();
    format!("{id:03X}#{digits}")
}

fn board_log(frames: &[String]) -> String {
    let line = |(index, frame)| format!("({index}.0) can0 {frame}\n");
    frames.iter().enumerate().map(line).collect()
}

/// Whatever the cause: the number beside it is not a measured one.
#[test]
fn what_the_board_marks_as_not_valid_is_missing() {
    let causes = (0..8).map(|bit| 1_u64 << bit).chain([0]);
    for (id, start, column_name, factor) in [
        (0x101, 32, "i_meas_a", 1e-3),
        (0x102, 24, "CurrentAverage.CurrentAverage_a", 1e-3),
        (0x110, 24, "q_meas_c", 1e-3),
        (0x112, 24, "soc_pct", 0.01),
    ] {
        let frames: Vec<String> = causes
            .clone()
            .map(|causes| board_frame(id, 3, &[(16, causes), (start, 1500)]))
            .collect();
        let (recording, decoded) = decode_with(BOARD, &board_log(&frames), None).unwrap();
        let expected = [[-1.0; 8].as_slice(), &[1500.0 * factor]].concat();
        assert_eq!(column(&recording, column_name), expected, "{column_name}");
        assert_eq!((decoded.frames, decoded.invalid, decoded.broken), (9, 8, 0));
    }
    // What nothing is said against stays, and so do the causes.
    let frames = [board_frame(0x101, 0, &[(16, 16), (32, 1500), (53, 1)])];
    let (recording, _) = decode_with(BOARD, &board_log(&frames), None).unwrap();
    assert_eq!(column(&recording, "range_high"), [1.0]);
    assert_eq!(column(&recording, "Current.CurrentValidity"), [16.0]);
    // Each of several by its own causes; "not available" is none that was left out.
    let data = 5_000_u64 | 64 << 16 | 250 << 24 | 0x800 << 44 | 1 << 56;
    let log = board_log(&[hex(0x130, &data.to_le_bytes())]);
    let (recording, decoded) = decode_with(BOARD, &log, None).unwrap();
    assert_eq!(column(&recording, "v_supply_v"), [-1.0]);
    assert_eq!(column(&recording, "temp_sensor_c"), [25.0]);
    assert_eq!(decoded.invalid, 1);
    // A frame that ends before its causes says nothing for its value.
    let log = board_log(&[hex(0x130, &data.to_le_bytes()[..2])]);
    let (recording, decoded) = decode_with(BOARD, &log, None).unwrap();
    assert_eq!(column(&recording, "v_supply_v"), [-1.0]);
    assert_eq!((decoded.invalid, decoded.short), (1, 1));
}

#[test]
fn another_vehicles_signal_of_such_a_name_is_no_validity() {
    let database = r#"VERSION ""

BU_: A

BO_ 16 Shunt: 8 A
 SG_ Current : 0|16@1- (1,0) [0|0] "A" A
 SG_ CurrentValidity : 16|8@1+ (1,0) [0|0] "" A

BA_DEF_ BO_ "E2EProfile" STRING;
BA_DEF_ BO_ "E2EDataId" INT 0 4095;
BA_DEF_DEF_ "E2EProfile" "none";
BA_DEF_DEF_ "E2EDataId" 0;
BA_ "E2EProfile" BO_ 16 "P11C";
BA_ "E2EDataId" BO_ 16 16;
"#;
    let (recording, decoded) = decode_with(database, "(0.0) can0 010#050001\n", None).unwrap();
    assert_eq!(column(&recording, "Shunt.Current_a"), [5.0]);
    assert_eq!((decoded.invalid, decoded.broken), (0, 0));
}

#[test]
fn frames_that_are_not_as_they_were_sent_are_left_out() {
    let good = board_frame(0x101, 3, &[(32, 1500)]);
    let (recording, decoded) =
        decode_with(BOARD, &board_log(std::slice::from_ref(&good)), None).unwrap();
    assert_eq!(column(&recording, "i_meas_a"), [1.5]);
    assert_eq!((decoded.frames, decoded.broken), (1, 0));
    let mut frames = vec![good.clone()];
    // A digit of the CRC, of counter and data ID, and of the value.
    for at in [4, 6, 7, 12] {
        let digit = if good.as_bytes()[at] == b'5' {
            "6"
        } else {
            "5"
        };
        frames.push([&good[..at], digit, &good[at + 1..]].concat());
    }
    // Another message's, the reserved counter, and one that is too short.
    frames.push(good.replace("101#", "102#"));
    frames.push(board_frame(0x101, 15, &[(32, 1500)]));
    frames.push(good[..good.len() - 2].to_owned());
    let (recording, decoded) = decode_with(BOARD, &board_log(&frames), None).unwrap();
    assert_eq!(recording.time_s(), [0.0]);
    assert_eq!(column(&recording, "i_meas_a"), [1.5]);
    assert_eq!((decoded.frames, decoded.broken, decoded.short), (1, 7, 0));
    // Without a whole one it is said why there is nothing.
    let database = Database::parse("board.dbc", BOARD.as_bytes()).unwrap();
    let mut decoder = Decoder::new(&database, "log", None, true);
    let log = board_log(&frames[1..]);
    log::candump::read("log", None, log.as_bytes(), &mut |frame| {
        decoder.frame(frame)
    })
    .unwrap();
    assert_eq!(
        decoder.finish().unwrap_err().to_string(),
        "log: found 7 frames that their end-to-end check does not let pass, and no others of the database, expected \
         frames as they were sent"
    );
}

#[test]
fn a_log_without_a_known_signal_is_no_recording() {
    let error = decode("(1.0) can0 7FF#0100\n").unwrap_err();
    assert_eq!(
        error.to_string(),
        "log: found no values, expected at least one signal that the database describes"
    );
}

#[test]
fn signals_get_the_names_that_are_asked_for() {
    let database = Database::parse("v.dbc", DATABASE.as_bytes()).unwrap();
    let merged = || {
        let mut decoder = Decoder::new(&database, "log", None, true);
        let log = "(1.0) can0 010#0100010000\n(1.1) can0 011#02\n";
        log::candump::read("log", None, log.as_bytes(), &mut |frame: &Frame<'_>| {
            decoder.frame(frame)
        })
        .unwrap();
        Merged::new("log", decoder.finish().unwrap().0).unwrap()
    };
    let mapped = |argument| merged().mapped(&Mapping::parse([argument]).unwrap());
    // With the unit's ending or without, and with its sign turned.
    for (argument, value) in [
        ("i_ref_a=Shunt.Current", 0.001),
        ("i_ref_a=Shunt.Current_a", 0.001),
        ("i_ref_a=-Shunt.Current", -0.001),
    ] {
        let read = mapped(argument).unwrap().recording().unwrap();
        assert_eq!(read.need("i_ref_a").unwrap()[0], value);
        assert!(read.column("Shunt.Current_a").is_none());
    }
    assert_eq!(
        mapped("v_cell_v=Shunt.Current").unwrap_err().to_string(),
        "log: found \"Shunt.Current\" in A, expected V, as \"v_cell_v\" ends"
    );
    assert_eq!(
        mapped("v_cell_v=Shunt.Voltage").unwrap_err().to_string(),
        "log: found the signals Shunt.Current_a, Shunt.Page, Shunt.Volt_v, Shunt.Temp_c, Other.Level_pct, \
         expected a signal \"Shunt.Voltage\""
    );
}

#[test]
fn databases_that_cannot_be_followed_are_placed() {
    let with = |line: &str| format!("{DATABASE}\nBO_ 18 Third: 8 A\n{line}\n");
    let cases = [
        (
            "VERSION \"\"\nBU_: A\nBO_ 16 Shunt: x A\n".to_owned(),
            "v.dbc, line 3, column 15: found what is no part of a DBC there, expected a DBC file",
        ),
        (
            with(" SG_ Wide : 0|65@1+ (1,0) [0|0] \"\" A"),
            "v.dbc, column Third.Wide: found a signal of 65 bits, expected 1 to 64",
        ),
        (
            with(" SG_ Paged m1 : 0|8@1+ (1,0) [0|0] \"\" A"),
            "v.dbc, column Third.Paged: found the multiplexer \"M\", expected a multiplexer in the same message",
        ),
        (
            with(" SG_ Half : 0|16@1+ (1,0) [0|0] \"\" A\nSIG_VALTYPE_ 18 Half : 1;"),
            "v.dbc, column Third.Half: found a floating-point signal of 16 bits, expected 32",
        ),
        (
            with(
                " SG_ X m0M : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Y M : 0|8@1+ (1,0) [0|0] \"\" A\nSG_MUL_VAL_ 18 Y X 0-0;",
            ),
            "v.dbc, column Third.X: found a multiplexer that depends on itself, expected a chain of multiplexers with an end",
        ),
    ];
    for (database, sentence) in cases {
        let error = Database::parse("v.dbc", database.as_bytes()).unwrap_err();
        assert_eq!(error.to_string(), sentence);
    }
}

#[test]
fn units_of_editors_that_write_latin_1_are_known() {
    let mut bytes = DATABASE.replace("degC", "@C").into_bytes();
    for byte in &mut bytes {
        if *byte == b'@' {
            *byte = 0xB0;
        }
    }
    // The byte order marks are at signs as well: put them back.
    let mut text = Vec::new();
    for (index, byte) in bytes.iter().enumerate() {
        let of_unit = bytes.get(index + 1) == Some(&b'C');
        text.push(if *byte == 0xB0 && !of_unit {
            b'@'
        } else {
            *byte
        });
    }
    let database = Database::parse("v.dbc", &text).unwrap();
    let mut decoder = Decoder::new(&database, "log", None, true);
    let log = "(1.0) can0 010#0000024100\n";
    log::candump::read("log", None, log.as_bytes(), &mut |frame: &Frame<'_>| {
        decoder.frame(frame)
    })
    .unwrap();
    let read = Merged::new("log", decoder.finish().unwrap().0)
        .unwrap()
        .recording()
        .unwrap();
    assert_eq!(column(&read, "Shunt.Temp_c"), [25.0]);
}

/// Every bit of a signal, by the definition of both byte orders, one bit after the other.
fn raw_by_definition(
    data: &[u8; DATA_BYTES],
    big_endian: bool,
    start: u64,
    size: u64,
) -> Option<u64> {
    let mut raw = 0;
    let (mut byte, mut bit) = (start / 8, start % 8);
    for index in 0..size {
        let value = u64::from(*data.get(usize::try_from(byte).unwrap())? >> bit & 1);
        if big_endian {
            raw = raw << 1 | value;
            (byte, bit) = if bit == 0 {
                (byte + 1, 7)
            } else {
                (byte, bit - 1)
            };
        } else {
            raw |= value << index;
            (byte, bit) = if bit == 7 {
                (byte + 1, 0)
            } else {
                (byte, bit + 1)
            };
        }
    }
    Some(raw)
}

fn any_log() -> impl Strategy<Value = Vec<u8>> {
    let pieces = prop::sample::select(vec![
        "(1.5) can0 ",
        "123#",
        "123##1",
        "CANFD 1 Rx 20 1 0 2 2 ",
        "0011",
        "\n",
        "#",
        "R",
        "_9",
        "base hex\n",
        "0.5 1 ",
        "20x ",
        "Rx ",
        "d 2 ",
        "00 ",
        "date x\n",
        "LOGG",
        "LOBJ",
        "\u{90}\0\0\0",
        "\u{20}\0\u{1}\0",
        "\u{30}\0\0\0",
        "\u{1}\0\0\0",
        "\u{a}\0\0\0",
        "\0\0\0\0\0\0\0\0",
        "-",
        "99999999999999999999",
    ]);
    let text = prop::collection::vec(pieces, 0..40).prop_map(|pieces| {
        let text = pieces.concat();
        text.chars()
            .map(|letter| u8::try_from(letter).unwrap_or(0))
            .collect::<Vec<u8>>()
    });
    prop_oneof![text, prop::collection::vec(any::<u8>(), 0..300)]
}

proptest! {
    #[test]
    fn bits_are_those_of_the_definition(
        data in prop::collection::vec(any::<u8>(), DATA_BYTES),
        big_endian: bool,
        start in 0_u64..520,
        size in 1_u64..=64,
        length in prop::sample::select(vec![0_usize, 1, 5, 8, 12, 48, 64, 64]),
    ) {
        let order = if big_endian { 0 } else { 1 };
        let database = format!(
            "VERSION \"\"\n\nBU_: A\n\nBO_ 16 M: 64 A\n SG_ S : {start}|{size}@{order}+ (1,0) [0|0] \"\" A\n"
        );
        let database = Database::parse("v.dbc", database.as_bytes()).unwrap();
        let mut decoder = Decoder::new(&database, "log", None, true);
        let mut kept = [0; DATA_BYTES];
        kept[..length].copy_from_slice(&data[..length]);
        decoder.frame(&Frame {
            time_ns: 0, bus: "0", id: 16, extended: false, length, data: kept, place: Default::default(),
        }).unwrap();
        let (series, decoded) = decoder.finish().unwrap();
        let value = series[0].signals[0].values[0];
        let last_byte = |bit: u64| bit / 8 < length as u64;
        let expected = raw_by_definition(&kept, big_endian, start, size).filter(|_| {
            // All its bytes were sent.
            if big_endian { last_byte((start / 8) * 8 + (7 - start % 8) + size - 1) } else { last_byte(start + size - 1) }
        });
        match expected {
            Some(raw) => prop_assert_eq!(value, raw as f64),
            None => prop_assert!(value.is_nan()),
        }
        prop_assert_eq!(decoded.short, u64::from(expected.is_none()));
    }

    #[test]
    fn no_bytes_make_a_reader_panic(bytes in any_log()) {
        for reader in READERS {
            if let Err(error) = read(reader, &bytes) {
                let placed = error.place().line.is_some() || error.place().offset.is_some();
                prop_assert!(placed || error.to_string().contains("no header"), "{}", error);
            }
        }
    }

    #[test]
    fn no_database_makes_it_panic(text in "(VERSION \"\"|BU_: A|BO_ 1 M: 8 A| SG_ S m0M : 0|8@1[+]|[(]1,0[)] |[\\[]0|0\\] \"\" A|\n|SG_MUL_VAL_ 1 S S 0-0;|x|9){0,30}") {
        let _ = Database::parse("v.dbc", text.as_bytes());
    }

    /// Rows hold each value once, at its time.
    #[test]
    fn merging_loses_and_invents_nothing(
        steps in prop::collection::vec((0_u32..3, any::<bool>()), 1..60),
    ) {
        let mut log = String::new();
        let mut now_ms = 0;
        for (index, (step_ms, other)) in steps.iter().enumerate() {
            now_ms += step_ms;
            let id = if *other { "011" } else { "010" };
            log.push_str(&format!("(1.{now_ms:03}) can0 {id}#{index:02X}00\n"));
        }
        let (read, _) = decode(&log).unwrap();
        let mut found = Vec::new();
        for (name, factor) in [("Shunt.Current_a", 1000.0), ("Other.Level_pct", 2.0)] {
            for (time_s, value) in read.time_s().iter().zip(read.column(name).unwrap_or_default()) {
                if !value.is_nan() {
                    found.push(((value * factor).round() as usize, time_s.to_bits()));
                }
            }
        }
        found.sort_unstable();
        let mut now_ms = 0;
        let first_ms = steps[0].0;
        let given: Vec<_> = steps.iter().enumerate().map(|(index, (step_ms, _))| {
            now_ms += step_ms;
            (index, (f64::from(now_ms - first_ms) / 1e3).to_bits())
        }).collect();
        prop_assert_eq!(found, given);
        // No row without a value.
        prop_assert!(read.len() <= steps.len());
    }
}
