//! One charge interval against a mocked bus: the bytes are those of the chip.

use ade7753::{Ade7753, Error, Options};
use embedded_hal::spi::ErrorKind;
use embedded_hal_mock::eh1::spi::{Mock, Transaction};

/// One register read: command, the 4 µs gap, data.
fn read(address: u8, data: &[u8]) -> Vec<Transaction<u8>> {
    vec![
        Transaction::transaction_start(),
        Transaction::write_vec(vec![address]),
        Transaction::delay(4_000),
        Transaction::read_vec(data.to_vec()),
        Transaction::transaction_end(),
    ]
}

fn main() -> Result<(), Error<ErrorKind>> {
    // AENERGY just below its positive end, then just past it; each is followed by CHKSUM, its number of ones.
    let session = [
        read(0x02, &[0x7F, 0xFF, 0xF0]),
        read(0x3E, &[19]),
        read(0x02, &[0x80, 0x00, 0x10]),
        read(0x3E, &[2]),
    ]
    .concat();
    let mut meter = Ade7753::new(Mock::new(&session), Options::default());

    let start = meter.energy()?;
    let end = meter.energy()?;
    println!(
        "AENERGY {} -> {}: {} counts",
        start.0,
        end.0,
        end.since(start).0
    );
    meter.release().done();
    Ok(())
}
