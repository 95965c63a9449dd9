use super::*;
use crate::modbus::register::Row;
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::string::{String, ToString};
use std::vec::Vec;

/// Any value of any field, each kept only if the whole is still valid.
fn configuration() -> impl Strategy<Value = Configuration> {
    let change = (any::<prop::sample::Index>(), any::<u8>(), any::<u64>());
    (0..4i64, prop::collection::vec(change, 0..60)).prop_map(|(front_end, changes)| {
        let mut configuration = Configuration::default();
        assert_eq!(FIELDS[0].put(&mut configuration, 0, front_end), Ok(()));
        for (row, element, at) in changes {
            let field = &FIELDS[row.index(FIELDS.len())];
            let element = usize::from(element) % usize::from(field.layout.count);
            let (min, max) = field.limits();
            let span = (max - min) as u64;
            let value = min.wrapping_add((at % (span + 1)) as i64);
            let mut changed = configuration;
            if field.put(&mut changed, element, value).is_ok() && changed.validate().is_ok() {
                configuration = changed;
            }
        }
        configuration
    })
}

fn record(configuration: &Configuration) -> Vec<u8> {
    let mut buffer = [0; MAX_RECORD];
    encode(configuration, &mut buffer).unwrap().to_vec()
}

fn sealed(payload: &[u8]) -> Vec<u8> {
    let mut bytes = VERSION.to_le_bytes().to_vec();
    bytes.extend((payload.len() as u16).to_le_bytes());
    bytes.extend(payload);
    let crc = CRC.checksum(&bytes);
    bytes.extend(crc.to_le_bytes());
    bytes
}

fn values(configuration: &Configuration) -> Vec<((u16, usize), Option<i64>)> {
    FIELDS
        .iter()
        .flat_map(|field| {
            (0..usize::from(field.layout.count)).map(|element| {
                (
                    (field.layout.address, element),
                    field.get(configuration, element),
                )
            })
        })
        .collect()
}

fn field(address: u16) -> &'static Field {
    FIELDS
        .iter()
        .find(|field| field.layout.address == address)
        .unwrap()
}

#[test]
fn no_interval_waits_until_the_meter_is_stale() {
    // Stale after 100 ms; the reading that ends the wait comes up to a poll later.
    let poll_us = crate::design_parameters::METER_POLL_MS * 1_000;
    let (_, longest_us) = field(0x0514).limits();
    assert!(longest_us + i64::try_from(poll_us).unwrap() <= 100_000);
}

#[test]
fn the_factory_s_configuration_is_valid_with_every_front_end() {
    for front_end in 0..4 {
        let mut configuration = Configuration::default();
        field(0x0100).put(&mut configuration, 0, front_end).unwrap();
        assert_eq!(configuration.validate(), Ok(()), "{front_end}");
        assert_eq!(field(0x0100).get(&configuration, 0), Some(front_end));
        assert_eq!(decode(&record(&configuration)), Ok(configuration));
    }
}

#[test]
fn the_table_is_in_order_and_its_limits_fit_their_types() {
    assert_eq!(FIELDS.len(), FIELD_TEXTS.len());
    let mut end = crate::modbus::COMMAND_ADDRESS + 1;
    let mut names = BTreeSet::new();
    for (field, text) in FIELDS.iter().zip(FIELD_TEXTS) {
        let layout = field.layout();
        assert!(layout.address >= end, "{}", text.name);
        assert!(
            layout.count > 0 && layout.end() > layout.address,
            "{}",
            text.name
        );
        assert!(
            layout.kind.width() == 1 || layout.address % 2 == 0,
            "{}",
            text.name
        );
        let (min, max) = field.limits();
        assert!(min < max, "{}", text.name);
        assert!(
            min >= layout.kind.min() && max <= layout.kind.max(),
            "{}",
            text.name
        );
        assert!(
            !text.name.is_empty() && names.insert(text.name),
            "{}",
            text.name
        );
        end = layout.end();
    }
}

#[test]
fn each_setting_is_itself_and_no_other() {
    for front_end in 0..4 {
        let mut base = Configuration::default();
        FIELDS[0].put(&mut base, 0, front_end).unwrap();
        let before = values(&base);
        for field in &FIELDS[1..] {
            let (min, max) = field.limits();
            for element in 0..usize::from(field.layout.count) {
                let Some(old) = field.get(&base, element) else {
                    let id = FieldId {
                        address: field.layout.address,
                        element,
                    };
                    let mut changed = base;
                    let refused = field.put(&mut changed, element, min);
                    assert_eq!(refused, Err(Violation::NotInUse(id)));
                    assert_eq!(changed, base);
                    continue;
                };
                for new in [min, max] {
                    let mut changed = base;
                    assert_eq!(field.put(&mut changed, element, new), Ok(()), "{field:?}");
                    for (was, is) in before.iter().zip(values(&changed)) {
                        let expected = if was.0 == (field.layout.address, element) {
                            Some(new)
                        } else {
                            was.1
                        };
                        assert_eq!(is, (was.0, expected), "{field:?}");
                    }
                    assert!(changed.crc() != base.crc() || old == new);
                }
            }
            // No element behind the last.
            let behind = usize::from(field.layout.count);
            if behind > 1 {
                assert_eq!(field.get(&base, behind), None);
                assert!(field.put(&mut base.clone(), behind, min).is_err());
            }
        }
    }
}

#[test]
fn a_value_beyond_its_limits_is_named() {
    for field in FIELDS {
        let (min, max) = field.limits();
        for value in [min - 1, max + 1] {
            let mut configuration = Configuration::default();
            assert_eq!(
                field.put(&mut configuration, 0, value),
                Err(Violation::OutOfLimits {
                    field: FieldId {
                        address: field.layout.address,
                        element: 0
                    },
                    value,
                    min,
                    max,
                })
            );
            assert_eq!(configuration, Configuration::default());
        }
    }
    let mut configuration = Configuration::default();
    configuration.rtu.address = 248;
    let refused = decode(&record(&configuration)).unwrap_err();
    assert_eq!(
        refused.to_string(),
        "Modbus address[0] is 248, its limits are 1 and 247"
    );
    assert_eq!(
        FieldId {
            address: 1,
            element: 0
        }
        .name(),
        "unknown"
    );
}

#[test]
fn another_front_end_comes_with_its_defaults_and_the_same_one_keeps_its_values() {
    let mut configuration = Configuration::default();
    field(0x0108).put(&mut configuration, 0, 2_600_000).unwrap();
    FIELDS[0].put(&mut configuration, 0, 0).unwrap();
    assert_eq!(field(0x0108).get(&configuration, 0), Some(2_600_000));
    FIELDS[0].put(&mut configuration, 0, 1).unwrap();
    FIELDS[0].put(&mut configuration, 0, 0).unwrap();
    assert_eq!(configuration, Configuration::default());
}

#[test]
fn settings_that_contradict_each_other_are_refused() {
    let mut configuration = Configuration::default();
    field(0x0782).put(&mut configuration, 1, 0).unwrap();
    let found = configuration.validate().unwrap_err();
    assert_eq!(
        found,
        Violation::Contradiction(Contradiction::Ocv(crate::ocv::OcvTableError::SocNotRising(
            1
        )))
    );
    assert!(found.to_string().starts_with("open-circuit table: point 1"));
    assert_eq!(
        decode(&record(&configuration)),
        Err(ConfigurationError::Invalid(found))
    );
    let mut configuration = Configuration::default();
    // Small above large.
    field(0x0102)
        .put(&mut configuration, 0, 700_000_000)
        .unwrap();
    let found = configuration.validate().unwrap_err();
    assert_eq!(
        found,
        Violation::Contradiction(Contradiction::FrontEnd(
            crate::front_end::FrontEndError::FullScale
        ))
    );
    assert_eq!(found.to_string(), "contradiction: FrontEnd(FullScale)");
}

/// Each condition that the parts have beside those is of one value, and no value in the limits of [`FIELDS`] breaks it.
#[test]
fn the_parts_refuse_no_more_than_the_limits_and_the_contradictions() {
    for field in FIELDS {
        for element in 0..usize::from(field.layout.count) {
            let (min, max) = field.limits();
            for value in [min, max] {
                let mut c = Configuration::default();
                if field.put(&mut c, element, value).is_err() {
                    continue;
                }
                let converter = c.converter.validate();
                assert_eq!(converter.is_ok(), c.converter.gain == Gain::X1, "{field:?}");
                let within = c.zero_drift.value_is_within_limit();
                assert_eq!(c.zero_drift.is_valid(), within, "{field:?}");
                let threshold = c.open_sensor.threshold_is_valid(&c.front_end);
                assert_eq!(c.open_sensor.is_valid(&c.front_end), threshold, "{field:?}");
            }
        }
    }
}

#[test]
fn each_contradiction_is_found() {
    type Change = fn(&mut Configuration);
    let cases: [(Change, Contradiction); 14] = [
        (
            |c| c.converter.gain = crate::converter::Gain::X2,
            Contradiction::Converter(ConverterConfigError::Gain),
        ),
        (
            |c| c.zero_drift.value.small = Microamps(c.zero_drift.limit.small.get() + 1),
            Contradiction::ZeroDrift,
        ),
        (
            // The network's own open level is 0.148 V.
            |c| c.open_sensor.open_below = Some(crate::units::Microvolts(100_000)),
            Contradiction::OpenSensor,
        ),
        (
            |c| c.temperature_limits = [TEMPERATURE_LOW, TEMPERATURE_LOW],
            Contradiction::Temperature,
        ),
        (
            |c| c.key_calibration.settle_ms = c.key_calibration.max_delay_ms,
            Contradiction::KeyCalibrationDelay,
        ),
        (
            // 17 · 125 ms.
            |c| c.converter.data_rate = crate::converter::DataRate::Sps8,
            Contradiction::KeyCalibrationDelay,
        ),
        (
            // 42 · 31.25 ms and 200 ms.
            |c| c.key_calibration.samples = 41,
            Contradiction::KeyCalibrationDelay,
        ),
        (
            |c| c.compare.fast_window_ms = c.compare.slow_window_ms,
            Contradiction::CompareWindows,
        ),
        (
            // Two conversions of 125 ms: what is compared waits for the one that spans it.
            |c| {
                c.key_calibration.enabled = false;
                c.converter.data_rate = crate::converter::DataRate::Sps8;
                c.compare.fast_window_ms = 249;
            },
            Contradiction::CompareWindows,
        ),
        (
            |c| {
                c.key_calibration.enabled = false;
                c.converter.data_rate = crate::converter::DataRate::Sps8;
                c.average.max_gap_ms = 249;
            },
            Contradiction::AverageGap,
        ),
        (
            |c| c.meter.switching_current = c.flag.small_full_scale,
            Contradiction::SwitchingCurrent,
        ),
        (|c| c.edge_storm.events = 21, Contradiction::Storm),
        (
            |c| (c.meter_line_storm.events, c.meter_line_storm.window_us) = (100, 4_999),
            Contradiction::Storm,
        ),
        (
            |c| c.meter.full_scale.large = Microamps(1),
            Contradiction::Derived,
        ),
    ];
    for (change, contradiction) in cases {
        let mut configuration = Configuration::default();
        change(&mut configuration);
        let found = Err(Violation::Contradiction(contradiction));
        assert_eq!(configuration.validate(), found);
    }
}

/// The limits of this firmware count, whatever one before has let through and saved: a record is judged when it is read, at the start and
/// by `restore`.
#[test]
fn a_stored_interval_that_wears_the_flash_out_is_refused() {
    let interval = |nanocoulombs| {
        let mut configuration = Configuration::default();
        configuration.save_policy.charge_interval = crate::units::Nanocoulombs(nanocoulombs);
        decode(&record(&configuration)).map(|read| assert_eq!(read, configuration))
    };
    assert_eq!(interval(30_000_000_000), Ok(()));
    for value in [1_000_000_000, 29_999_999_999] {
        let refused = Violation::OutOfLimits {
            field: FieldId {
                address: 0x0840,
                element: 0,
            },
            value,
            min: 30_000_000_000,
            max: 100_000_000_000_000,
        };
        assert_eq!(interval(value), Err(ConfigurationError::Invalid(refused)));
    }
}

#[test]
fn what_is_repeated_follows_its_origin() {
    let mut configuration = Configuration::default();
    configuration.meter.switching_current = Microamps(50_000_000);
    configuration.front_end = crate::front_end::FrontEnd::Hah1bv(Default::default());
    assert!(configuration.validate().is_err());
    let mut store = ConfigurationStore::default();
    // Whoever commits need not think of it.
    assert_eq!(store.commit(configuration), Ok(()));
    let active = store.active();
    assert_eq!(
        active.meter.full_scale,
        PerRange::both(Microamps(562_500_000))
    );
    assert_eq!(active.flag.switching_current, Microamps(50_000_000));
    assert_eq!(active.flag.small_full_scale, Microamps(500_000_000));
}

#[test]
fn every_setting_has_a_row() {
    fn leaves(value: &serde_json::Value) -> usize {
        match value {
            serde_json::Value::Array(items) => items.iter().map(leaves).sum(),
            serde_json::Value::Object(members) => members.values().map(leaves).sum(),
            _ => 1,
        }
    }
    for front_end in 0..4 {
        let mut configuration = Configuration::default();
        FIELDS[0].put(&mut configuration, 0, front_end).unwrap();
        let all = leaves(&serde_json::to_value(configuration).unwrap());
        let rows = values(&configuration)
            .iter()
            .filter(|(_, value)| value.is_some())
            .count();
        // `derive` fills four; the row `front end` is the variant's name and no leaf.
        assert_eq!(all - 4, rows - 1, "front end {front_end}");
    }
}

#[test]
fn the_record_has_the_documented_shape() {
    let configuration = Configuration::default();
    let bytes = record(&configuration);
    assert_eq!(bytes[..2], VERSION.to_le_bytes());
    let length = usize::from(u16::from_le_bytes([bytes[2], bytes[3]]));
    assert_eq!(bytes.len(), length + 8);
    let mut payload = Vec::new();
    for (_, value) in values(&configuration) {
        let Some(value) = value else { continue };
        payload.extend(postcard::to_slice(&value, &mut [0; 10]).unwrap().iter());
    }
    assert_eq!(bytes[4..4 + length], payload);
    assert_eq!(bytes, sealed(&payload));
    // Check value of CRC-32/ISO-HDLC.
    assert_eq!(CRC.checksum(b"123456789"), 0xCBF4_3926);
}

#[test]
fn every_bit_and_every_byte_of_the_record_counts() {
    let bytes = record(&Configuration::default());
    for bit in 0..bytes.len() * 8 {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        let found = decode(&damaged).unwrap_err();
        match bit / 8 {
            0 | 1 => assert!(matches!(found, ConfigurationError::WrongVersion { .. })),
            2 | 3 => assert!(matches!(
                found,
                ConfigurationError::TooShort { .. } | ConfigurationError::TrailingBytes(_)
            )),
            _ => assert!(matches!(found, ConfigurationError::WrongCrc { .. })),
        }
    }
    for length in 0..bytes.len() {
        let needed = if length < HEADER {
            HEADER + TRAILER
        } else {
            bytes.len()
        };
        assert_eq!(
            decode(&bytes[..length]),
            Err(ConfigurationError::TooShort {
                needed,
                found: length
            })
        );
        let mut buffer = std::vec![0; length];
        assert_eq!(
            encode(&Configuration::default(), &mut buffer),
            Err(BufferTooSmall)
        );
    }
    let mut exact = std::vec![0; bytes.len()];
    assert_eq!(
        encode(&Configuration::default(), &mut exact),
        Ok(&bytes[..])
    );
    let mut longer = bytes;
    longer.extend([0, 0]);
    assert_eq!(decode(&longer), Err(ConfigurationError::TrailingBytes(2)));
}

#[test]
fn errors_say_what_was_expected() {
    let texts: Vec<String> = [
        ConfigurationError::TooShort {
            needed: 8,
            found: 3,
        },
        ConfigurationError::WrongVersion { known: 1, found: 9 },
        ConfigurationError::TrailingBytes(2),
        ConfigurationError::WrongCrc {
            computed: 1,
            found: 2,
        },
        ConfigurationError::Malformed,
        ConfigurationError::Invalid(Violation::NotInUse(FieldId {
            address: 0x0112,
            element: 0,
        })),
    ]
    .iter()
    .map(ToString::to_string)
    .collect();
    assert_eq!(
        texts,
        [
            "3 bytes of at least 8",
            "version 9, this firmware reads version 1",
            "2 bytes too many",
            "CRC 0x00000002, computed 0x00000001",
            "not a configuration",
            "HAH1BV: full scale[0] does not belong to the front end in use",
        ]
    );
}

#[test]
fn a_payload_that_is_none_or_too_long_is_refused_though_its_crc_is_right() {
    // The front end alone, and a number that does not end.
    for payload in [&[0][..], &[], &[0xFF; 11]] {
        assert_eq!(decode(&sealed(payload)), Err(ConfigurationError::Malformed));
    }
    // Front end 9 does not exist.
    let violation = Violation::OutOfLimits {
        field: FieldId {
            address: 0x0100,
            element: 0,
        },
        value: 9,
        min: 0,
        max: 3,
    };
    assert_eq!(
        decode(&sealed(&[18])),
        Err(ConfigurationError::Invalid(violation))
    );
    let bytes = record(&Configuration::default());
    let mut payload = bytes[HEADER..bytes.len() - TRAILER].to_vec();
    payload.push(0);
    assert_eq!(
        decode(&sealed(&payload)),
        Err(ConfigurationError::TrailingBytes(1))
    );
}

#[test]
fn any_configuration_fits_the_record() {
    let mut longest = 0;
    for front_end in 0..4 {
        // Not valid as a whole, but as long as it gets: the varint of the larger magnitude is the longer one.
        let mut configuration = Configuration::default();
        FIELDS[0].put(&mut configuration, 0, front_end).unwrap();
        for field in &FIELDS[1..] {
            let (min, max) = field.limits();
            for element in 0..usize::from(field.layout.count) {
                let largest = if min.unsigned_abs() > max.unsigned_abs() {
                    min
                } else {
                    max
                };
                let _ = field.put(&mut configuration, element, largest);
            }
        }
        longest = longest.max(record(&configuration).len());
    }
    assert!(longest <= MAX_RECORD, "{longest}");
    // Not far more than is needed either: the buffer is static RAM.
    assert!(longest + 32 > MAX_RECORD, "{longest}");
}

#[test]
fn a_refused_change_leaves_everything_as_it_was() {
    let mut store = ConfigurationStore::default();
    let before = *store.active();
    let mut staged = *store.stage().unwrap();
    staged.rtu.address = 0;
    assert!(matches!(
        store.commit(staged),
        Err(CommitError::Invalid(Violation::OutOfLimits {
            value: 0,
            min: 1,
            ..
        }))
    ));
    assert_eq!(
        decode(&[1, 2, 3]),
        Err(ConfigurationError::TooShort {
            needed: 8,
            found: 3
        })
    );
    assert!(matches!(
        store.load(staged),
        Err(Violation::OutOfLimits { value: 0, .. })
    ));
    assert_eq!((*store.active(), store.generation()), (before, 0));
    assert_eq!(store.crc(), before.crc());
    staged.rtu.address = 9;
    assert_eq!(store.commit(staged), Ok(()));
    assert_eq!((store.active().rtu.address, store.generation()), (9, 1));
    assert_eq!(store.crc(), staged.crc());
    // The same again is no change.
    assert_eq!(store.commit(staged), Ok(()));
    assert_eq!((store.active().rtu.address, store.generation()), (9, 1));
    assert_eq!(store.load(decode(&record(&before)).unwrap()), Ok(()));
    assert_eq!((*store.active(), store.generation()), (before, 2));
    assert_eq!(store.stage(), Ok(&before));
    assert_eq!(store.generation(), 2);
    store.commit(staged).unwrap();
    store.factory_defaults();
    assert_eq!(
        (*store.active(), store.generation()),
        (Configuration::default(), 4)
    );
}

/// F22.
#[test]
fn a_corrupted_configuration_gives_way_to_the_stored_one_and_is_never_built_upon() {
    let mut good = Configuration::default();
    good.rtu.address = 17;
    let mut store = ConfigurationStore::default();
    store.commit(good).unwrap();
    store.corrupt();
    assert_eq!(store.stage(), Err(Corrupted));
    assert_eq!(store.commit(good), Err(CommitError::Corrupted));
    assert_eq!(store.generation(), 1);
    assert_eq!(store.load(good), Ok(()));
    assert_eq!((store.stage(), store.generation()), (Ok(&good), 2));
    // Where nothing is stored.
    store.corrupt();
    assert_eq!(store.stage(), Err(Corrupted));
    store.factory_defaults();
    assert_eq!(store.stage(), Ok(&Configuration::default()));
    assert_eq!(store.generation(), 3);
    // So is what follows from other settings, and the kept CRC.
    let currents: [fn(&mut Configuration) -> &mut Microamps; 4] = [
        |c| &mut c.meter.full_scale.small,
        |c| &mut c.meter.full_scale.large,
        |c| &mut c.flag.switching_current,
        |c| &mut c.flag.small_full_scale,
    ];
    for current in currents {
        current(&mut store.active.configuration).0 ^= 1;
        assert_eq!(store.stage(), Err(Corrupted));
        assert_eq!(store.load(good), Ok(()));
        assert_eq!(store.stage(), Ok(&good));
    }
    store.active.crc ^= 1;
    assert_eq!(store.stage(), Err(Corrupted));
    assert_eq!(store.load(good), Ok(()));
    assert_eq!(store.stage(), Ok(&good));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn a_valid_configuration_survives_the_record(configuration in configuration()) {
        prop_assert_eq!(configuration.validate(), Ok(()));
        prop_assert_eq!(decode(&record(&configuration)), Ok(configuration));
    }

    #[test]
    fn a_flipped_bit_is_rejected(configuration in configuration(), bit: prop::sample::Index) {
        let mut bytes = record(&configuration);
        let bit = bit.index(bytes.len() * 8);
        bytes[bit / 8] ^= 1 << (bit % 8);
        prop_assert!(decode(&bytes).is_err());
    }

    #[test]
    fn different_configurations_have_different_checksums(a in configuration(), b in configuration()) {
        prop_assert_eq!(a == b, a.crc() == b.crc());
    }

    #[test]
    fn any_bytes_are_decoded_to_something_valid_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        for bytes in [sealed(&bytes), bytes] {
            if let Ok(configuration) = decode(&bytes) {
                prop_assert_eq!(configuration.validate(), Ok(()));
            }
        }
    }

    #[test]
    fn a_damaged_payload_with_a_right_crc_never_gets_past_the_limits(
        at: prop::sample::Index,
        with: u8,
    ) {
        let bytes = record(&Configuration::default());
        let mut payload = bytes[HEADER..bytes.len() - TRAILER].to_vec();
        let at = at.index(payload.len());
        payload[at] = with;
        if let Ok(configuration) = decode(&sealed(&payload)) {
            prop_assert_eq!(configuration.validate(), Ok(()));
        }
    }
}
