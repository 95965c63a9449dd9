//! The async flavour: the same methods, awaited.

use ads1100::{Address, Ads1100Async, Settings};
use embedded_hal_mock::eh1::i2c::{Mock, Transaction};

fn main() {
    let mut bus = Mock::new(&[
        Transaction::write(0x49, vec![0x9C]),
        Transaction::read(0x49, vec![0x12, 0x34, 0x9C]),
    ]);
    let conversion = pollster::block_on(async {
        let mut adc = Ads1100Async::new(&mut bus, Address::A1, Settings::default());
        adc.start().await?;
        adc.poll().await
    });
    println!("{conversion:?}");
    bus.done();
}
