//! W25Q32 against the figures of its data sheet (W25Q32JV).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use plant::{
    bus::{SpiByte, SpiDevice},
    w25q32::{CAPACITY, PAGE, SECTOR, Timing, Violation, W25q32, W25q32Config},
};
use proptest::prelude::*;

const BUSY: u8 = 1;
const WEL: u8 = 2;

/// A chip and a master.
struct Bench {
    chip: W25q32,
    now_s: f64,
    clock_hz: f64,
    mode: u8,
}

impl Bench {
    fn new() -> Self {
        Self::with(W25q32Config::default(), Vec::new())
    }

    fn with(config: W25q32Config, content: Vec<u8>) -> Self {
        Self {
            chip: W25q32::with_content(config, 0.0, content),
            now_s: 0.0,
            clock_hz: 21e6,
            mode: 0,
        }
    }

    fn wait(&mut self, s: f64) {
        self.now_s += s;
        self.chip.advance(self.now_s);
    }

    /// One chip select: what comes back after `out`.
    fn transfer(&mut self, out: &[u8], answer: usize) -> Vec<u8> {
        self.wait(1e-7);
        self.chip.select(self.now_s);
        let mut received = Vec::new();
        for index in 0..out.len() + answer {
            let start_s = self.now_s;
            self.wait(8.0 / self.clock_hz);
            let byte = self.chip.exchange(SpiByte {
                mosi: out.get(index).copied().unwrap_or(0),
                mode: self.mode,
                clock_hz: self.clock_hz,
                start_s,
                end_s: self.now_s,
            });
            if index >= out.len() {
                received.push(byte);
            }
        }
        self.chip.deselect(self.now_s);
        received
    }

    fn command(&mut self, code: u8, address: usize, data: &[u8]) {
        let mut out = vec![
            code,
            (address >> 16) as u8,
            (address >> 8) as u8,
            address as u8,
        ];
        out.extend(data);
        self.transfer(&out, 0);
    }

    fn status(&mut self) -> u8 {
        self.transfer(&[0x05], 1)[0]
    }

    fn enable(&mut self) {
        self.transfer(&[0x06], 0);
    }

    fn read(&mut self, address: usize, length: usize) -> Vec<u8> {
        let out = [
            0x03,
            (address >> 16) as u8,
            (address >> 8) as u8,
            address as u8,
        ];
        self.transfer(&out, length)
    }

    /// Starts a program; it is not finished yet.
    fn program(&mut self, address: usize, data: &[u8]) {
        self.enable();
        self.command(0x02, address, data);
    }

    fn erase(&mut self, address: usize) {
        self.enable();
        self.command(0x20, address, &[]);
    }

    /// How long the operation under way takes, to 10 µs.
    fn busy_s(&mut self) -> f64 {
        let start_s = self.now_s;
        while self.status() & BUSY != 0 {
            self.wait(9e-6);
        }
        self.now_s - start_s
    }

    fn count(&self, kind: Violation) -> u64 {
        self.chip.violations().count(kind)
    }
}

fn slowest() -> W25q32Config {
    W25q32Config {
        timing: Timing::SLOWEST,
        ..W25q32Config::default()
    }
}

#[test]
fn it_says_who_it_is() {
    let mut bench = Bench::new();
    assert_eq!(bench.transfer(&[0x9F], 3), [0xEF, 0x40, 0x16]);
    assert_eq!(
        bench.transfer(&[0x90, 0, 0, 0], 4),
        [0xEF, 0x15, 0xEF, 0x15]
    );
    assert_eq!(bench.transfer(&[0x90, 0, 0, 1], 2), [0x15, 0xEF]);
    assert_eq!(bench.transfer(&[0xAB, 0, 0, 0], 2), [0x15, 0x15]);
    let id = W25q32Config::default().unique_id;
    assert_eq!(bench.transfer(&[0x4B, 0, 0, 0, 0], 8), id);
    bench.mode = 3;
    assert_eq!(bench.transfer(&[0x9F], 3), [0xEF, 0x40, 0x16]);
    assert_eq!(bench.chip.violations().total(), 0);
}

#[test]
fn reads_go_on_through_the_whole_chip_and_around() {
    let content: Vec<u8> = (0..CAPACITY).map(|at| (at % 251) as u8).collect();
    let mut bench = Bench::with(W25q32Config::default(), content.clone());
    assert_eq!(
        bench.read(0x12_3456, 600),
        content[0x12_3456..0x12_3456 + 600]
    );
    let around = bench.read(CAPACITY - 3, 6);
    assert_eq!(around[..3], content[CAPACITY - 3..]);
    assert_eq!(around[3..], content[..3]);
    // Fast read has a dummy byte.
    assert_eq!(
        bench.transfer(&[0x0B, 0x12, 0x34, 0x56, 0xFF], 5),
        content[0x12_3456..0x12_345B]
    );
    assert_eq!(bench.chip.violations().total(), 0);
}

#[test]
fn a_program_clears_bits_and_nothing_else() {
    let mut bench = Bench::new();
    bench.program(0x1000, &[0xF0, 0x3C]);
    assert_eq!(bench.status(), BUSY | WEL);
    bench.wait(1e-3);
    assert_eq!(bench.status(), 0);
    bench.program(0x1000, &[0x55, 0xFF]);
    bench.wait(1e-3);
    assert_eq!(bench.read(0x0FFF, 4), [0xFF, 0x50, 0x3C, 0xFF]);
    bench.erase(0x1ABC);
    bench.wait(0.1);
    assert_eq!(bench.read(0x0FFF, 4), [0xFF; 4]);
    assert_eq!(bench.chip.violations().total(), 0);
}

#[test]
fn a_program_wraps_in_its_page_and_keeps_the_last_bytes() {
    let mut bench = Bench::new();
    let data: Vec<u8> = (0..100).collect();
    bench.program(0x20FF - 9, &data);
    bench.wait(1e-3);
    assert_eq!(bench.read(0x20F6, 10), data[..10]);
    assert_eq!(bench.read(0x2000, 90), data[10..]);
    assert_eq!(bench.read(0x2100, 4), [0xFF; 4]);
    // 300 bytes from the page's begin: the last 256 stay.
    let long: Vec<u8> = (0..300)
        .map(|at| (at % 256) as u8 ^ ((at >> 8) as u8 * 0x80))
        .collect();
    bench.program(0x3000, &long);
    bench.wait(1e-3);
    assert_eq!(bench.read(0x3000, 44), long[256..]);
    assert_eq!(bench.read(0x302C, 212), long[44..256]);
}

#[test]
fn operations_take_the_sheets_times() {
    for (config, page_s, sector_s, half_s, block_s, status_s) in [
        (
            W25q32Config::default(),
            0.7e-3,
            45e-3,
            120e-3,
            150e-3,
            10e-3,
        ),
        (slowest(), 3e-3, 400e-3, 1.6, 2.0, 15e-3),
    ] {
        let mut bench = Bench::with(config, Vec::new());
        bench.program(0, &[0; PAGE]);
        // 256 · tBP2 + tBP1 come to a little less than tPP.
        let page = bench.busy_s();
        assert!((0.9 * page_s..page_s + 3e-5).contains(&page), "{page}");
        for (code, expected_s) in [(0x20, sector_s), (0x52, half_s), (0xD8, block_s)] {
            bench.enable();
            bench.command(code, 0, &[]);
            let taken_s = bench.busy_s();
            assert!((taken_s - expected_s).abs() < 3e-5, "{code:#x} {taken_s}");
        }
        bench.enable();
        bench.transfer(&[0x01, 0x00], 0);
        let taken_s = bench.busy_s();
        assert!((taken_s - status_s).abs() < 3e-5, "{taken_s}");
    }
    let mut bench = Bench::new();
    bench.program(0, &[0]);
    let taken_s = bench.busy_s();
    assert!((30e-6..60e-6).contains(&taken_s), "{taken_s}");
}

#[test]
fn erases_have_their_sizes() {
    let zeros = vec![0; CAPACITY];
    for (code, size) in [(0x20, SECTOR), (0x52, 0x8000), (0xD8, 0x1_0000)] {
        let mut bench = Bench::with(W25q32Config::default(), zeros.clone());
        let inside = 0x12_3456;
        bench.enable();
        bench.command(code, inside, &[]);
        bench.wait(1.0);
        let start = inside / size * size;
        let content = bench.chip.content();
        assert!(
            content[start..start + size]
                .iter()
                .all(|byte| *byte == 0xFF)
        );
        let ones = content.iter().filter(|byte| **byte != 0).count();
        assert_eq!(ones, size);
        assert_eq!(bench.chip.erase_count(inside), 1);
        assert_eq!(bench.chip.erase_count(start + size), 0);
    }
    for code in [0xC7, 0x60] {
        let mut bench = Bench::with(W25q32Config::default(), zeros.clone());
        bench.enable();
        bench.transfer(&[code], 0);
        bench.wait(9.9);
        assert!(bench.chip.is_busy());
        bench.wait(0.2);
        assert!(bench.chip.content().iter().all(|byte| *byte == 0xFF));
    }
}

#[test]
fn nothing_is_written_without_write_enable() {
    let mut bench = Bench::new();
    bench.command(0x02, 0, &[0]);
    bench.command(0x20, 0, &[]);
    bench.transfer(&[0xC7], 0);
    bench.transfer(&[0x01, 0x04], 0);
    assert_eq!(bench.count(Violation::NotEnabled), 4);
    bench.enable();
    assert_eq!(bench.status(), WEL);
    bench.transfer(&[0x04], 0);
    assert_eq!(bench.status(), 0);
    bench.command(0x02, 0, &[0]);
    assert_eq!(bench.count(Violation::NotEnabled), 5);
    // One enable, one write.
    bench.program(0, &[0x7F]);
    bench.wait(1e-3);
    bench.command(0x02, 1, &[0]);
    assert_eq!(bench.count(Violation::NotEnabled), 6);
    assert_eq!(bench.read(0, 2), [0x7F, 0xFF]);
}

#[test]
fn commands_with_the_wrong_length_do_nothing() {
    let mut bench = Bench::new();
    bench.transfer(&[0x06, 0], 0);
    assert_eq!(bench.status(), 0);
    bench.enable();
    bench.command(0x20, 0, &[0]);
    bench.transfer(&[0x20, 0, 0], 0);
    bench.command(0x02, 0, &[]);
    bench.transfer(&[0xC7, 0], 0);
    assert_eq!(bench.count(Violation::BadLength), 5);
    assert_eq!(bench.status(), WEL);
}

#[test]
fn while_busy_only_the_status_answers() {
    let mut bench = Bench::with(W25q32Config::default(), vec![0x5A; CAPACITY]);
    bench.erase(0);
    assert_eq!(bench.read(0x8000, 2), [0xFF, 0xFF]);
    assert_eq!(bench.transfer(&[0x9F], 3), [0xFF; 3]);
    bench.enable();
    bench.command(0x02, 0x8000, &[0]);
    assert_eq!(bench.count(Violation::Busy), 4);
    // Read continuously, the status shows the end.
    let bytes = bench.transfer(&[0x05], 130_000);
    assert_eq!(bytes[0], BUSY | WEL);
    assert_eq!(bytes[129_999], 0);
    assert_eq!(bench.read(0x8000, 2), [0x5A, 0x5A]);
    assert_eq!(bench.count(Violation::Busy), 4);
}

#[test]
fn power_down_ignores_all_but_the_release() {
    let mut bench = Bench::new();
    bench.transfer(&[0xB9], 0);
    bench.wait(4e-6);
    assert_eq!(bench.transfer(&[0x9F], 1), [0xFF]);
    assert_eq!(bench.status(), 0xFF);
    assert_eq!(bench.count(Violation::PoweredDown), 2);
    bench.transfer(&[0xAB], 0);
    // tRES1: 3 µs.
    bench.wait(2e-6);
    assert_eq!(bench.transfer(&[0x9F], 1), [0xFF]);
    assert_eq!(bench.count(Violation::NotReady), 1);
    bench.wait(1e-6);
    assert_eq!(bench.transfer(&[0x9F], 1), [0xEF]);
}

#[test]
fn a_reset_needs_its_enable_right_before() {
    let mut bench = Bench::new();
    bench.enable();
    bench.transfer(&[0x99], 0);
    assert_eq!(bench.status(), WEL);
    bench.transfer(&[0x66], 0);
    bench.status();
    bench.transfer(&[0x99], 0);
    assert_eq!(bench.status(), WEL);
    bench.transfer(&[0x66], 0);
    bench.transfer(&[0x99], 0);
    assert_eq!(bench.status(), 0xFF);
    bench.wait(30e-6);
    assert_eq!(bench.status(), 0);
    assert_eq!(bench.count(Violation::ResetWhileBusy), 0);
    bench.erase(0);
    bench.transfer(&[0x66], 0);
    bench.transfer(&[0x99], 0);
    assert_eq!(bench.count(Violation::ResetWhileBusy), 1);
}

#[test]
fn status_registers_keep_what_is_written() {
    let mut bench = Bench::new();
    assert_eq!(bench.transfer(&[0x15], 1), [0x60]);
    // Both bytes of 01h; BUSY and WEL cannot be written.
    bench.enable();
    bench.transfer(&[0x01, 0x07, 0x0A], 0);
    bench.wait(0.02);
    assert_eq!(bench.status(), 0x04);
    assert_eq!(bench.transfer(&[0x35], 1), [0x0A]);
    // LB1 can only be set.
    bench.enable();
    bench.transfer(&[0x31, 0x00], 0);
    bench.wait(0.02);
    assert_eq!(bench.transfer(&[0x35], 1), [0x08]);
    // A volatile write is gone after power-on.
    bench.transfer(&[0x50], 0);
    bench.transfer(&[0x01, 0x1C], 0);
    assert_eq!(bench.status(), 0x1C);
    bench.chip.power_off(bench.now_s);
    bench.chip.power_on(bench.now_s + 0.1);
    bench.wait(0.11);
    assert_eq!(bench.status(), 0x04);
    assert_eq!(bench.chip.violations().total(), 0);
}

#[test]
fn protected_blocks_are_not_written() {
    // BP, TB and SEC with the first and the last protected address (status register memory protection).
    for (status, second, first, last) in [
        (0x04, 0x00, 0x3F_0000, 0x3F_FFFF),
        (0x18, 0x00, 0x20_0000, 0x3F_FFFF),
        (0x24, 0x00, 0x00_0000, 0x00_FFFF),
        (0x30, 0x00, 0x00_0000, 0x07_FFFF),
        (0x1C, 0x00, 0x00_0000, 0x3F_FFFF),
        (0x44, 0x00, 0x3F_F000, 0x3F_FFFF),
        (0x50, 0x00, 0x3F_8000, 0x3F_FFFF),
        (0x64, 0x00, 0x00_0000, 0x00_0FFF),
        (0x04, 0x40, 0x00_0000, 0x3E_FFFF),
    ] {
        let mut bench = Bench::with(
            W25q32Config {
                status: [status, second, 0x60],
                ..W25q32Config::default()
            },
            Vec::new(),
        );
        for (address, protected) in [
            (Some(first), true),
            (Some(last), true),
            (usize::checked_sub(first, 1), false),
            (Some(last + 1).filter(|at| *at < CAPACITY), false),
        ] {
            let Some(address) = address else { continue };
            bench.chip.clear_violations();
            bench.program(address, &[0]);
            bench.wait(1e-3);
            let expected = if protected { 0xFF } else { 0x00 };
            assert_eq!(
                bench.read(address, 1),
                [expected],
                "{status:#x} {address:#x}"
            );
            assert_eq!(bench.count(Violation::Protected), u64::from(protected));
        }
    }
}

#[test]
fn modes_and_clocks_are_watched() {
    let mut bench = Bench::new();
    for mode in [1, 2] {
        bench.mode = mode;
        assert_ne!(bench.transfer(&[0x9F], 3), [0xEF, 0x40, 0x16]);
        assert!(bench.count(Violation::WrongMode) > 0);
        bench.chip.clear_violations();
    }
    bench.mode = 0;
    bench.clock_hz = 80e6;
    assert_eq!(bench.transfer(&[0x9F], 3), [0xEF, 0x40, 0x16]);
    bench.read(0, 4);
    assert!(bench.count(Violation::ClockTooFast) > 0);
    bench.clock_hz = 50e6;
    bench.chip.clear_violations();
    bench.read(0, 4);
    assert_eq!(bench.chip.violations().total(), 0);
    // Chip select high for 20 ns only.
    bench.now_s += 20e-9;
    bench.chip.select(bench.now_s);
    assert_eq!(bench.count(Violation::SelectHigh), 1);
}

#[test]
fn commands_that_are_not_modelled_or_not_there_are_reported() {
    let mut bench = Bench::new();
    bench.transfer(&[0x5A, 0, 0, 0, 0], 4);
    bench.transfer(&[0x6B, 0, 0, 0, 0], 4);
    assert_eq!(bench.count(Violation::Unmodelled), 2);
    bench.transfer(&[0x00], 0);
    bench.transfer(&[0xFF], 0);
    assert_eq!(bench.count(Violation::UnknownCommand), 2);
}

// -------------------------------------------------------------------------------------------------------- faults

#[test]
fn without_power_there_is_nobody_and_power_on_takes_its_time() {
    let mut bench = Bench::new();
    bench.program(0, &[0x12]);
    bench.wait(1e-3);
    bench.chip.power_off(bench.now_s + 1e-3);
    assert_eq!(bench.read(0, 1), [0x12]);
    bench.wait(2e-3);
    assert!(!bench.chip.is_powered());
    assert_eq!(bench.read(0, 1), [0xFF]);
    bench.chip.power_on(bench.now_s);
    bench.wait(10e-6);
    assert_eq!(bench.read(0, 1), [0xFF]);
    assert_eq!(bench.count(Violation::NotReady), 1);
    bench.wait(20e-6);
    assert_eq!(bench.read(0, 1), [0x12]);
    // tPUW: 5 ms until it writes.
    bench.program(1, &[0]);
    assert_eq!(bench.count(Violation::NotReady), 2);
    bench.wait(5e-3);
    bench.program(1, &[0]);
    bench.wait(1e-3);
    assert_eq!(bench.read(0, 2), [0x12, 0x00]);
}

#[test]
fn a_program_cut_off_in_time_has_written_its_first_bytes() {
    for share in [0.1, 0.501, 0.9] {
        let mut bench = Bench::new();
        let length_s = 30e-6 + 255.0 * 2.5e-6;
        bench.program(0x4000, &[0; PAGE]);
        bench.chip.power_off(bench.now_s + share * length_s);
        bench.wait(1e-3);
        let page = &bench.chip.content()[0x4000..0x4100];
        let done = (share * 256.0) as usize;
        assert!(page[..done].iter().all(|byte| *byte == 0));
        assert!(page[done + 1..].iter().all(|byte| *byte == 0xFF));
        assert_eq!(bench.chip.lost_power(), None);
    }
}

#[test]
fn power_fails_after_the_ordered_number_of_bytes() {
    let old = 0xC3;
    let mut under_way = std::collections::BTreeSet::new();
    for seed in 0..2 {
        for allowance in 0..40u64 {
            let config = W25q32Config {
                seed,
                ..W25q32Config::default()
            };
            let mut bench = Bench::with(config, vec![old; 0x2000]);
            bench.chip.shut_off_after(allowance);
            for page in 0..4 {
                bench.program(page * 0x100, &[0x42; 10]);
                bench.wait(1e-3);
            }
            // 40 bytes in all; the last allowance is one short of them.
            let lost_s = bench.chip.lost_power().expect("lost");
            assert!(lost_s < bench.now_s && !bench.chip.is_powered());
            for index in 0..40 {
                let byte = bench.chip.content()[index / 10 * 0x100 + index % 10];
                let at = index as u64;
                if at < allowance {
                    assert_eq!(byte, old & 0x42);
                } else if at == allowance {
                    // Between old and new.
                    assert_eq!(byte & !old, 0);
                    assert_eq!(byte & (old & 0x42), old & 0x42);
                    under_way.insert(byte);
                } else {
                    assert_eq!(byte, old);
                }
            }
        }
    }
    // The bits that fall are 7 and 0: every combination.
    assert_eq!(
        under_way.into_iter().collect::<Vec<_>>(),
        [0x42, 0x43, 0xC2, 0xC3]
    );
    let mut bench = Bench::new();
    bench.chip.shut_off_after(40);
    for page in 0..4 {
        bench.program(page * 0x100, &[0x42; 10]);
        bench.wait(1e-3);
    }
    assert_eq!(bench.chip.lost_power(), None);
    bench.program(0x500, &[0x42]);
    bench.wait(1e-3);
    assert!(bench.chip.lost_power().is_some());
    bench.chip.power_on(bench.now_s);
    bench.wait(6e-3);
    bench.program(0x600, &[0x42]);
    bench.wait(1e-3);
    assert_eq!(bench.read(0x600, 1), [0x42], "once");
}

#[test]
fn an_erase_cut_off_leaves_old_bits_and_ones() {
    let mut ones = Vec::new();
    for done in [0, 1_024, 2_048, 4_095] {
        let mut bench = Bench::with(W25q32Config::default(), vec![0x0F; 0x3000]);
        bench.chip.shut_off_after(done);
        bench.erase(0x1000);
        bench.wait(0.1);
        let expected_s = 45e-3 * done as f64 / 4_096.0;
        let lost_s = bench.chip.lost_power().expect("lost");
        assert!((lost_s - expected_s).abs() < 1e-5, "{lost_s}");
        let content = bench.chip.content();
        assert!(content[..0x1000].iter().all(|byte| *byte == 0x0F));
        assert!(content[0x2000..0x3000].iter().all(|byte| *byte == 0x0F));
        let sector = &content[0x1000..0x2000];
        assert!(
            sector.iter().all(|byte| byte & 0x0F == 0x0F),
            "only sets bits"
        );
        let set: u32 = sector.iter().map(|byte| (byte >> 4).count_ones()).sum();
        ones.push(f64::from(set) / (4.0 * 4_096.0));
        assert_eq!(bench.chip.erase_count(0x1000), 0);
    }
    for (share, expected) in ones.iter().zip([0.0, 0.25, 0.5, 0.999_8]) {
        assert!((share - expected).abs() < 0.02, "{ones:?}");
    }
}

#[test]
fn what_a_loss_of_power_leaves_depends_on_the_seed_alone() {
    let left = |seed: u64| {
        let config = W25q32Config {
            seed,
            ..W25q32Config::default()
        };
        let mut bench = Bench::with(config, vec![0x00; 0x1000]);
        bench.chip.shut_off_after(2_000);
        bench.erase(0);
        bench.wait(0.1);
        bench.chip.into_content()[..0x1000].to_vec()
    };
    assert_eq!(left(3), left(3));
    assert_ne!(left(3), left(4));
}

#[test]
fn rotten_and_worn_bits_stay() {
    let mut bench = Bench::with(W25q32Config::default(), vec![0x00; 0x2000]);
    bench.chip.flip_bits(0x10, 0x81);
    assert_eq!(bench.read(0x10, 1), [0x81]);
    bench.chip.wear_out(0x123, 0x08);
    bench.erase(0);
    bench.wait(0.1);
    let sector = bench.read(0, SECTOR);
    for (at, byte) in sector.iter().enumerate() {
        assert_eq!(*byte, if at == 0x123 { 0xF7 } else { 0xFF });
    }
}

#[derive(Clone, Debug)]
enum Step {
    Program(usize, Vec<u8>),
    Erase(usize),
    PowerCycle(f64),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (0..0x3000usize, prop::collection::vec(any::<u8>(), 1..300))
            .prop_map(|(at, data)| Step::Program(at, data)),
        1 => (0..0x3000usize).prop_map(Step::Erase),
        1 => (0.0..1e-3f64).prop_map(Step::PowerCycle),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn without_an_erase_bits_only_fall(steps in prop::collection::vec(step(), 1..20), seed in any::<u64>()) {
        let config = W25q32Config { seed, ..W25q32Config::default() };
        let mut bench = Bench::with(config, Vec::new());
        let mut before = bench.chip.content()[..0x4000].to_vec();
        let mut cut_s = None;
        for step in steps {
            let mut erased = None;
            let mut written = None;
            match step {
                Step::Program(at, data) => {
                    bench.program(at, &data);
                    written = Some((at / PAGE, data));
                }
                Step::Erase(at) => {
                    bench.erase(at);
                    erased = Some(at / SECTOR);
                }
                // Cuts off the operation that comes next.
                Step::PowerCycle(after_s) => {
                    cut_s = Some(after_s);
                    continue;
                }
            }
            let cut = cut_s.take();
            if let Some(after_s) = cut {
                bench.chip.power_off(bench.now_s + after_s);
                bench.chip.power_on(bench.now_s + 0.06);
            }
            bench.wait(0.07);
            let after = bench.chip.content()[..0x4000].to_vec();
            for (at, (old, new)) in before.iter().zip(&after).enumerate() {
                if erased == Some(at / SECTOR) {
                    // Sets only, and all of them unless cut off.
                    prop_assert_eq!(new & old, *old);
                    prop_assert!(cut.is_some() || *new == 0xFF);
                } else if written.as_ref().is_some_and(|(page, _)| *page == at / PAGE) {
                    prop_assert_eq!(new & !old, 0);
                } else {
                    prop_assert_eq!(new, old);
                }
            }
            before = after;
        }
        prop_assert_eq!(bench.chip.violations().total(), 0);
    }
}
