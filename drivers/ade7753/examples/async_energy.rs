//! The async flavour: the same methods, awaited.

use ade7753::{Ade7753Async, Error, Options};
use embedded_hal_mock::eh1::spi::{Mock, Transaction};

async fn run(bus: &mut Mock<u8>) -> Result<(), Error<embedded_hal::spi::ErrorKind>> {
    let mut meter = Ade7753Async::new(bus, Options::default());
    let snapshot = meter.energy_snapshot().await?;
    match snapshot.verified() {
        Some(energy) => println!("AENERGY {}", energy.0),
        None => println!("corrupted: {:#x}", snapshot.raw()),
    }
    Ok(())
}

fn main() {
    let mut bus = Mock::new(&[
        Transaction::transaction_start(),
        Transaction::write_vec(vec![0x02]),
        Transaction::delay(4_000),
        Transaction::read_vec(vec![0xFF, 0xFF, 0xFE]),
        Transaction::write_vec(vec![0x3E]),
        Transaction::delay(4_000),
        Transaction::read_vec(vec![23]),
        Transaction::transaction_end(),
    ]);
    let result = pollster::block_on(run(&mut bus));
    assert!(result.is_ok());
    bus.done();
}
