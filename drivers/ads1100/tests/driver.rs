//! The driver against a mocked bus.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]

use ads1100::{Address, Ads1100, Conversion, DataRate, Error, Gain, Operation, Sample, Settings};
use embedded_hal::i2c::{ErrorKind, NoAcknowledgeSource};
use embedded_hal_mock::eh1::i2c::{Mock, Transaction};
use proptest::prelude::*;

const ADDRESSES: [Address; 8] = [
    Address::A0,
    Address::A1,
    Address::A2,
    Address::A3,
    Address::A4,
    Address::A5,
    Address::A6,
    Address::A7,
];
const RATES: [DataRate; 4] = [
    DataRate::Sps128,
    DataRate::Sps32,
    DataRate::Sps16,
    DataRate::Sps8,
];
const GAINS: [Gain; 4] = [Gain::X1, Gain::X2, Gain::X4, Gain::X8];
const NACK: ErrorKind = ErrorKind::NoAcknowledge(NoAcknowledgeSource::Address);

fn settings(data_rate: DataRate, gain: Gain) -> Settings {
    Settings { data_rate, gain }
}

/// What a start reads at 0x48 when the last conversion, with 32 SPS and gain 1, is over.
fn idle() -> Transaction {
    Transaction::read(0x48, vec![0, 0, 0x14])
}

/// Runs `test` with a driver at 0x48, 32 SPS, gain 1 (0x14 when idle, 0x94 when busy) whose first conversion is over.
fn ready(transactions: &[Transaction], test: impl FnOnce(&mut Ads1100<&mut Mock>)) {
    let start = [
        Transaction::write(0x48, vec![0x94]),
        Transaction::read(0x48, vec![0, 0, 0x14]),
    ];
    let mut mock = Mock::new(&[&start, transactions].concat());
    let mut adc = Ads1100::new(&mut mock, Address::A0, settings(DataRate::Sps32, Gain::X1));
    assert_eq!(adc.start(), Ok(()));
    assert_eq!(adc.poll(), Ok(Conversion::Discarded));
    test(&mut adc);
    mock.done();
}

#[test]
fn a_result_is_delivered_when_finished_and_once() {
    ready(
        &[
            idle(),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0x01, 0x23, 0x94]),
            Transaction::read(0x48, vec![0xFE, 0xDC, 0x14]),
        ],
        |adc| {
            assert_eq!(adc.poll(), Err(Error::NotStarted));
            assert_eq!(adc.start(), Ok(()));
            assert_eq!(adc.poll(), Ok(Conversion::Busy));
            let sample = Sample {
                code: -0x124,
                settings: settings(DataRate::Sps32, Gain::X1),
            };
            assert_eq!(adc.poll(), Ok(Conversion::Ready(sample)));
            assert_eq!(adc.poll(), Err(Error::NotStarted));
        },
    );
}

#[test]
fn nothing_is_delivered_before_a_start() {
    let mut mock = Mock::new(&[]);
    let mut adc = Ads1100::new(&mut mock, Address::A0, Settings::default());
    assert_eq!(adc.poll(), Err(Error::NotStarted));
    assert_eq!(adc.read_continuous(), Err(Error::NotStarted));
    adc.release().done();
}

#[test]
fn every_address_rate_and_gain() {
    for (n, address) in (0u8..).zip(ADDRESSES) {
        for (dr, data_rate) in (0u8..).zip(RATES) {
            for (pga, gain) in (0u8..).zip(GAINS) {
                let bits = 0x10 | dr << 2 | pga;
                let mut mock = Mock::new(&[
                    Transaction::write(0x48 + n, vec![0x80 | bits]),
                    Transaction::read(0x48 + n, vec![0, 0, bits]),
                    Transaction::read(0x48 + n, vec![0, 0, bits]),
                    Transaction::write(0x48 + n, vec![0x80 | bits]),
                    Transaction::read(0x48 + n, vec![0xFF, 0xFF, bits]),
                ]);
                assert_eq!(address.bits(), 0x48 + n);
                let settings = settings(data_rate, gain);
                let mut adc = Ads1100::new(&mut mock, address, settings);
                assert_eq!(adc.settings(), settings);
                adc.start().unwrap();
                assert_eq!(adc.poll(), Ok(Conversion::Discarded));
                adc.start().unwrap();
                assert_eq!(
                    adc.poll(),
                    Ok(Conversion::Ready(Sample { code: -1, settings }))
                );
                mock.done();
            }
        }
    }
    assert_eq!(Address::default(), Address::A0);
    assert_eq!(Settings::default(), settings(DataRate::Sps8, Gain::X1));
}

#[test]
fn any_other_configuration_byte_is_a_lost_configuration() {
    // 0x14 written: only ST/BSY may differ. 0x8C is the reset state, 0x00 and 0xFF a stuck bus, 0x34 and 0x54 have the
    // reserved bits set.
    for byte in 0..=u8::MAX {
        if byte & 0x7F == 0x14 {
            continue;
        }
        ready(
            &[
                idle(),
                Transaction::write(0x48, vec![0x94]),
                Transaction::read(0x48, vec![0x12, 0x34, byte]),
                Transaction::write(0x48, vec![0x94]),
                Transaction::read(0x48, vec![0, 0, 0x14]),
                idle(),
                Transaction::write(0x48, vec![0x94]),
                Transaction::read(0x48, vec![0, 1, 0x14]),
            ],
            |adc| {
                adc.start().unwrap();
                let lost = Error::ConfigurationLost {
                    expected: 0x94,
                    read: byte,
                };
                assert_eq!(adc.poll(), Err(lost));
                // The conversion is void, and so is the next one's result.
                assert_eq!(adc.poll(), Err(Error::NotStarted));
                adc.start().unwrap();
                assert_eq!(adc.poll(), Ok(Conversion::Discarded));
                adc.start().unwrap();
                assert!(matches!(adc.poll(), Ok(Conversion::Ready(sample)) if sample.code == 1));
            },
        );
    }
}

#[test]
fn a_reset_between_conversions_is_told_by_the_next_start() {
    ready(
        &[
            Transaction::read(0x48, vec![0, 0, 0x8C]),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0x12, 0x34, 0x14]),
            idle(),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0, 1, 0x14]),
        ],
        |adc| {
            let lost = Error::ConfigurationLost {
                expected: 0x94,
                read: 0x8C,
            };
            assert_eq!(adc.start(), Err(lost));
            assert_eq!(adc.poll(), Err(Error::NotStarted));
            adc.start().unwrap();
            assert_eq!(adc.poll(), Ok(Conversion::Discarded));
            adc.start().unwrap();
            assert!(matches!(adc.poll(), Ok(Conversion::Ready(sample)) if sample.code == 1));
        },
    );
}

#[test]
fn a_code_beyond_the_data_rates_range_is_an_error() {
    for (data_rate, max) in [
        (DataRate::Sps128, 2047),
        (DataRate::Sps32, 8191),
        (DataRate::Sps16, 16383),
        (DataRate::Sps8, 32767i16),
    ] {
        assert_eq!(data_rate.max_code(), max);
        assert_eq!(data_rate.min_code(), -max - 1);
        for code in [
            max,
            -max - 1,
            max.wrapping_add(1),
            (-max - 1).wrapping_sub(1),
        ] {
            let settings = settings(data_rate, Gain::X8);
            let bits = 0x13 | (data_rate as u8) << 2;
            let [high, low] = code.to_be_bytes();
            let mut mock = Mock::new(&[
                Transaction::write(0x48, vec![0x80 | bits]),
                Transaction::read(0x48, vec![0, 0, bits]),
                Transaction::read(0x48, vec![0, 0, bits]),
                Transaction::write(0x48, vec![0x80 | bits]),
                Transaction::read(0x48, vec![high, low, bits]),
            ]);
            let mut adc = Ads1100::new(&mut mock, Address::A0, settings);
            adc.start().unwrap();
            adc.poll().unwrap();
            adc.start().unwrap();
            let polled = adc.poll();
            if (-max - 1..=max).contains(&code) {
                assert_eq!(polled, Ok(Conversion::Ready(Sample { code, settings })));
            } else {
                assert_eq!(polled, Err(Error::CodeOutOfRange { code, data_rate }));
            }
            assert_eq!(adc.poll(), Err(Error::NotStarted));
            mock.done();
        }
    }
}

#[test]
fn bus_errors_keep_their_place_and_source() {
    ready(
        &[
            idle().with_error(NACK),
            idle(),
            Transaction::write(0x48, vec![0x94]).with_error(NACK),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0, 0, 0]).with_error(ErrorKind::ArbitrationLoss),
            Transaction::read(0x48, vec![0, 7, 0x14]),
            idle(),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0, 8, 0x14]),
            Transaction::write(0x48, vec![0x84]).with_error(NACK),
            Transaction::write(0x48, vec![0x84]),
            Transaction::read(0x48, vec![0, 0, 0]).with_error(ErrorKind::Bus),
            Transaction::read(0x48, vec![0, 9, 0x84]),
            Transaction::write(0x00, vec![0x06]).with_error(NACK),
        ],
        |adc| {
            let error = |operation, source| Error::Bus { operation, source };
            for operation in [Operation::ReadOutput, Operation::WriteConfiguration] {
                assert_eq!(adc.start(), Err(error(operation, NACK)));
                assert_eq!(adc.poll(), Err(Error::NotStarted));
            }
            assert_eq!(adc.start(), Ok(()));
            assert_eq!(
                adc.poll(),
                Err(error(Operation::ReadOutput, ErrorKind::ArbitrationLoss))
            );
            // The conversion goes on; it may be the one whose start the chip had taken all the same.
            assert_eq!(adc.poll(), Ok(Conversion::Discarded));
            assert_eq!(adc.start(), Ok(()));
            assert!(matches!(adc.poll(), Ok(Conversion::Ready(sample)) if sample.code == 8));
            assert_eq!(
                adc.start_continuous(),
                Err(error(Operation::WriteConfiguration, NACK))
            );
            assert_eq!(adc.read_continuous(), Err(Error::NotStarted));
            assert_eq!(adc.start_continuous(), Ok(()));
            assert_eq!(
                adc.read_continuous(),
                Err(error(Operation::ReadOutput, ErrorKind::Bus))
            );
            assert_eq!(adc.read_continuous().map(|sample| sample.code), Ok(9));
            assert_eq!(
                adc.general_call_reset(),
                Err(error(Operation::GeneralCallReset, NACK))
            );
        },
    );
}

#[test]
fn a_bus_error_while_restarting_voids_the_conversion_under_way() {
    ready(
        &[
            idle(),
            Transaction::write(0x48, vec![0x94]),
            Transaction::write(0x48, vec![0x94]).with_error(NACK),
            Transaction::write(0x48, vec![0x84]),
            Transaction::write(0x48, vec![0x84]).with_error(NACK),
        ],
        |adc| {
            adc.start().unwrap();
            assert!(adc.start().is_err());
            assert_eq!(adc.poll(), Err(Error::NotStarted));
            adc.start_continuous().unwrap();
            assert!(adc.start_continuous().is_err());
            assert_eq!(adc.read_continuous(), Err(Error::NotStarted));
        },
    );
}

#[test]
fn a_general_call_reset_voids_the_conversion_and_the_next_result() {
    ready(
        &[
            idle(),
            Transaction::write(0x48, vec![0x94]),
            Transaction::write(0x00, vec![0x06]),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0, 0, 0x14]),
            idle(),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0, 3, 0x14]),
        ],
        |adc| {
            adc.start().unwrap();
            assert_eq!(adc.general_call_reset(), Ok(()));
            assert_eq!(adc.poll(), Err(Error::NotStarted));
            adc.start().unwrap();
            assert_eq!(adc.poll(), Ok(Conversion::Discarded));
            adc.start().unwrap();
            assert!(matches!(adc.poll(), Ok(Conversion::Ready(sample)) if sample.code == 3));
        },
    );
}

#[test]
fn continuous_mode() {
    ready(
        &[
            Transaction::write(0x48, vec![0x84]),
            Transaction::read(0x48, vec![0, 9, 0x84]),
            Transaction::read(0x48, vec![0, 9, 0x84]),
            Transaction::read(0x48, vec![0x20, 0x00, 0x84]),
            Transaction::read(0x48, vec![0, 9, 0x04]),
            Transaction::write(0x48, vec![0x84]),
            Transaction::read(0x48, vec![0, 0, 0x8C]),
        ],
        |adc| {
            let sample = Sample {
                code: 9,
                settings: settings(DataRate::Sps32, Gain::X1),
            };
            assert_eq!(adc.start_continuous(), Ok(()));
            assert_eq!(adc.poll(), Err(Error::NotStarted));
            assert_eq!(adc.read_continuous(), Ok(sample));
            assert_eq!(adc.read_continuous(), Ok(sample));
            assert_eq!(
                adc.read_continuous(),
                Err(Error::CodeOutOfRange {
                    code: 0x2000,
                    data_rate: DataRate::Sps32
                })
            );
            assert_eq!(
                adc.read_continuous(),
                Err(Error::ConfigurationLost {
                    expected: 0x84,
                    read: 0x04
                })
            );
            assert_eq!(adc.read_continuous(), Err(Error::NotStarted));
            assert_eq!(adc.start_continuous(), Ok(()));
            assert_eq!(
                adc.read_continuous(),
                Err(Error::ConfigurationLost {
                    expected: 0x84,
                    read: 0x8C
                })
            );
        },
    );
}

#[test]
fn new_settings_void_the_conversion_under_way() {
    ready(
        &[
            idle(),
            Transaction::write(0x48, vec![0x94]),
            Transaction::read(0x48, vec![0, 0, 0x94]),
            Transaction::write(0x48, vec![0x99]),
            Transaction::read(0x48, vec![0x10, 0x00, 0x19]),
            Transaction::read(0x48, vec![0x10, 0x00, 0x19]),
            Transaction::write(0x48, vec![0x99]),
            Transaction::read(0x48, vec![0x20, 0x00, 0x19]),
        ],
        |adc| {
            adc.start().unwrap();
            let finer = settings(DataRate::Sps16, Gain::X2);
            adc.set_settings(finer);
            assert_eq!(adc.settings(), finer);
            assert_eq!(adc.poll(), Err(Error::NotStarted));
            // What ends first is the old one, with the old settings' resolution.
            adc.start().unwrap();
            assert_eq!(adc.poll(), Ok(Conversion::Discarded));
            adc.start().unwrap();
            let sample = Sample {
                code: 0x2000,
                settings: finer,
            };
            assert_eq!(adc.poll(), Ok(Conversion::Ready(sample)));
        },
    );
}

#[test]
fn conversion_times() {
    for (rate, samples_per_second, bits, nominal, worst, timeout) in [
        (DataRate::Sps128, 128, 12, 7_813, 9_375, 11_719),
        (DataRate::Sps32, 32, 14, 31_250, 37_500, 46_875),
        (DataRate::Sps16, 16, 15, 62_500, 75_000, 93_750),
        (DataRate::Sps8, 8, 16, 125_000, 150_000, 187_500),
    ] {
        assert_eq!(rate.samples_per_second(), samples_per_second);
        assert_eq!(rate.bits(), bits);
        assert_eq!(rate.conversion_us(), nominal);
        assert_eq!(rate.worst_conversion_us(), worst);
        assert_eq!(rate.timeout_us(), timeout);
    }
    assert_eq!(GAINS.map(Gain::factor), [1, 2, 4, 8]);
}

#[test]
fn microvolts() {
    let sample = |code, data_rate, gain| Sample {
        code,
        settings: settings(data_rate, gain),
    };
    // 2.5 V, half of a supply of 5 V, at every resolution.
    for (data_rate, half) in [
        (DataRate::Sps128, 1024),
        (DataRate::Sps32, 4096),
        (DataRate::Sps16, 8192),
        (DataRate::Sps8, 16384),
    ] {
        assert_eq!(
            sample(half, data_rate, Gain::X1).microvolts(5_000_000),
            2_500_000
        );
        assert_eq!(
            sample(-half, data_rate, Gain::X4).microvolts(5_000_000),
            -625_000
        );
    }
    // One step is 152.59 µV at 16 bits, 2441.4 µV at 12 bits.
    assert_eq!(
        sample(1, DataRate::Sps8, Gain::X1).microvolts(5_000_000),
        153
    );
    assert_eq!(
        sample(-1, DataRate::Sps8, Gain::X1).microvolts(5_000_000),
        -153
    );
    assert_eq!(
        sample(1, DataRate::Sps128, Gain::X1).microvolts(5_000_000),
        2_441
    );
    // Halves are rounded away from zero: 1·1024/2048 = 0.5.
    assert_eq!(sample(1, DataRate::Sps128, Gain::X1).microvolts(1_024), 1);
    assert_eq!(sample(1, DataRate::Sps128, Gain::X1).microvolts(1_023), 0);
    assert_eq!(sample(-1, DataRate::Sps128, Gain::X1).microvolts(1_024), -1);
    assert_eq!(sample(-1, DataRate::Sps128, Gain::X1).microvolts(1_023), 0);
    // Beyond i32.
    assert_eq!(
        sample(i16::MAX, DataRate::Sps8, Gain::X1).microvolts(u32::MAX),
        i32::MAX
    );
    assert_eq!(
        sample(i16::MIN, DataRate::Sps8, Gain::X1).microvolts(u32::MAX),
        i32::MIN
    );
    assert_eq!(sample(0, DataRate::Sps8, Gain::X1).microvolts(u32::MAX), 0);
}

#[test]
fn clipping() {
    for data_rate in RATES {
        let clipped = |code| {
            Sample {
                code,
                settings: settings(data_rate, Gain::X1),
            }
            .is_clipped()
        };
        assert!(clipped(data_rate.max_code()));
        assert!(clipped(data_rate.min_code()));
        assert!(!clipped(data_rate.max_code() - 1));
        assert!(!clipped(data_rate.min_code() + 1));
        assert!(!clipped(0));
    }
}

#[test]
fn errors_say_what_happened() {
    let cases: [(Error<ErrorKind>, &str); 4] = [
        (
            Error::Bus {
                operation: Operation::ReadOutput,
                source: ErrorKind::Bus,
            },
            "bus error in ReadOutput: Bus",
        ),
        (
            Error::ConfigurationLost {
                expected: 0x9C,
                read: 0x0C,
            },
            "configuration is 0x0c, expected 0x9c",
        ),
        (
            Error::CodeOutOfRange {
                code: 9000,
                data_rate: DataRate::Sps32,
            },
            "code 9000 is beyond 14 bits",
        ),
        (Error::NotStarted, "no conversion is under way"),
    ];
    for (error, text) in cases {
        assert_eq!(error.to_string(), text);
        let error: Box<dyn std::error::Error> = Box::new(error);
        assert!(error.source().is_none());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn microvolts_are_the_nearest_integer(
        rate in 0..4usize,
        gain in 0..4usize,
        code: i16,
        vdd in 0u32..5_500_000,
    ) {
        let settings = settings(RATES[rate], GAINS[gain]);
        let code = code >> (16 - settings.data_rate.bits());
        let microvolts = Sample { code, settings }.microvolts(vdd);
        let divisor = f64::from(1 << (settings.data_rate.bits() - 1)) * f64::from(settings.gain.factor());
        // Exact in f64: the product has less than 53 bits, the divisor is a power of two. `round` is half away from zero.
        let expected = (f64::from(code) * f64::from(vdd) / divisor).round();
        prop_assert_eq!(f64::from(microvolts), expected);
    }
}

#[cfg(feature = "async")]
mod asynchronous {
    use super::*;
    use ads1100::Ads1100Async;

    #[rustfmt::skip] // it would move the repetition's `$`
    macro_rules! session {
        ($adc:ident $(, $await:tt)?) => {{
            let mut results = Vec::new();
            macro_rules! call {
                        ($call:expr) => {
                            results.push(format!("{:?}", $call $(.$await)?))
                        };
                    }
            call!($adc.poll());
            call!($adc.general_call_reset());
            call!($adc.start());
            call!($adc.poll());
            call!($adc.poll());
            call!($adc.start());
            call!($adc.poll());
            call!($adc.start());
            call!($adc.poll());
            call!($adc.start());
            call!($adc.poll());
            $adc.set_settings(settings(DataRate::Sps128, Gain::X8));
            call!($adc.start_continuous());
            call!($adc.read_continuous());
            results.push(format!("{:?}", $adc.settings()));
            $adc.release().done();
            results
        }};
    }

    fn bus() -> Mock {
        Mock::new(&[
            Transaction::write(0x00, vec![0x06]),
            Transaction::write(0x4B, vec![0x9C]),
            Transaction::read(0x4B, vec![0x00, 0x00, 0x9C]),
            Transaction::read(0x4B, vec![0x00, 0x00, 0x1C]),
            Transaction::read(0x4B, vec![0x00, 0x00, 0x1C]),
            Transaction::write(0x4B, vec![0x9C]),
            Transaction::read(0x4B, vec![0x80, 0x00, 0x1C]),
            Transaction::read(0x4B, vec![0x80, 0x00, 0x1C]),
            Transaction::write(0x4B, vec![0x9C]),
            Transaction::read(0x4B, vec![0x00, 0x00, 0x8C]),
            Transaction::write(0x4B, vec![0x9C]).with_error(NACK),
            Transaction::write(0x4B, vec![0x83]),
            Transaction::read(0x4B, vec![0x00, 0x05, 0x83]),
        ])
    }

    #[test]
    fn both_flavours_do_the_same() {
        let mut adc = Ads1100::new(bus(), Address::A3, Settings::default());
        let blocking = session!(adc);
        let mut adc = Ads1100Async::new(bus(), Address::A3, Settings::default());
        let asynchronous = pollster::block_on(async { session!(adc, await) });
        assert_eq!(blocking, asynchronous);
        let kinds: Vec<_> = blocking
            .iter()
            .map(|result| result.split(['(', ' ']).nth(1).unwrap())
            .collect();
        assert_eq!(
            kinds,
            [
                "NotStarted)",
                "",
                "",
                "Busy)",
                "Discarded)",
                "",
                "Ready",
                "",
                "ConfigurationLost",
                "Bus",
                "NotStarted)",
                "",
                "Sample",
                "{"
            ]
        );
    }
}
