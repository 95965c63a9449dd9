//! Two conversions against a mocked bus: the first after power-up is discarded.

use ads1100::{Address, Ads1100, Conversion, DataRate, Error, Gain, Settings};
use embedded_hal::i2c::ErrorKind;
use embedded_hal_mock::eh1::i2c::{Mock, Transaction};

fn main() -> Result<(), Error<ErrorKind>> {
    let mut bus = Mock::new(&[
        Transaction::write(0x48, vec![0x94]),
        Transaction::read(0x48, vec![0x00, 0x00, 0x14]),
        Transaction::read(0x48, vec![0x00, 0x00, 0x14]),
        Transaction::write(0x48, vec![0x94]),
        Transaction::read(0x48, vec![0x00, 0x00, 0x94]),
        Transaction::read(0x48, vec![0x10, 0x00, 0x14]),
    ]);
    let settings = Settings {
        data_rate: DataRate::Sps32,
        gain: Gain::X1,
    };
    let mut adc = Ads1100::new(&mut bus, Address::A0, settings);
    for _ in 0..2 {
        adc.start()?;
        loop {
            // On a board: wait about `settings.data_rate.conversion_us()` here.
            match adc.poll()? {
                Conversion::Busy => println!("busy"),
                Conversion::Discarded => {
                    println!("first result discarded");
                    break;
                }
                Conversion::Ready(sample) => {
                    println!(
                        "code {}: {} µV at VDD = 5 V",
                        sample.code,
                        sample.microvolts(5_000_000)
                    );
                    break;
                }
            }
        }
    }
    bus.done();
    Ok(())
}
