//! The image of the Hallmark board: an RTIC app for the STM32F405RG. Tasks and their wiring; docs/firmware.md has the
//! tables of pins, tasks and peripherals.
#![no_std]
#![no_main]
#![expect(
    unused_lifetimes,
    reason = "of what RTIC's macro makes of an async task"
)]

use defmt_rtt as _;
use rtic_monotonics::systick::prelude::*;

mod analog;
mod board;
mod can_bus;
mod center;
mod clock;
mod converter;
mod fault;
mod flash;
mod i2c;
mod identity;
mod inputs;
mod meter;
mod pace;
mod retain;
mod rs485;
mod spi;
mod stack;
mod storage;
mod time;
mod watchdog;

systick_monotonic!(Mono, 1_000);

defmt::timestamp!("{=u64:us}", time::now().as_ticks());

#[rtic::app(
    device = stm32f4xx_hal::pac,
    peripherals = true,
    // Interrupts of peripherals that this board does not use; one per priority of software tasks.
    dispatchers = [UART4, UART5, USART6]
)]
mod app {
    use core::{
        convert::Infallible,
        pin::pin,
        sync::atomic::{AtomicU32, Ordering},
    };

    use core_logic::{
        check_in::{CheckIn, Task},
        configuration::{Configuration, ConfigurationStore},
        converter::{ConverterSample, PollPace},
        design_parameters,
        diagnosis::Code,
        front_end::{Channel, KeyFactors},
        gap::GapBridge,
        measurement::{ConverterFault, Order, prepare},
        meter::{MeterChannel, MeterReport},
        modbus::{Command, CommandState, Event, Readings},
        modbus_rtu::Server,
        retained::{RetainSlots, RetainedState, SavePolicy, Slot},
        units::{Duration, Instant, Nanocoulombs, elapsed},
    };
    use heapless::spsc;
    use rtic::Mutex as _;
    use rtic_monotonics::systick::prelude::*;
    use rtic_sync::signal::Signal;

    use crate::{
        Mono,
        analog::Analog,
        board::{self, Board, Edges, MeterLine},
        center::{Center, MeterLink},
        clock,
        converter::{Converter, Progress},
        identity,
        inputs::Lines,
        meter::{self, Meter, event},
        pace::{self, Pace},
        retain::{self, Previous, Stage},
        rs485::{Character, Port, QUEUE_LENGTH},
        stack,
        storage::{Storage, Stored},
        time,
        watchdog::Watchdog,
    };

    /// What the meter's task is asked to do.
    static METER_EVENTS: AtomicU32 = AtomicU32::new(0);
    static METER_WAKE: Signal<()> = Signal::new();
    /// Characters or a pause on RS485.
    static RS485_WAKE: Signal<()> = Signal::new();
    /// The tasks that have shown life since idle last looked, as bits of `Task`.
    static ALIVE: AtomicU32 = AtomicU32::new(0);

    /// `task` is alive.
    pub fn alive(task: Task) {
        ALIVE.fetch_or(1 << task as u32, Ordering::Relaxed);
    }

    /// The next time at which the milliseconds since the start divided by [`TICK_MS`] leave `phase_ms`.
    fn next_on_grid(phase_ms: u32) -> pace::Millisecond {
        let now = pace::now();
        let into = now.duration_since_epoch().as_millis() % TICK_MS;
        now + ((phase_ms + TICK_MS - into - 1) % TICK_MS + 1).millis()
    }

    fn ask_meter(events: u32) {
        METER_EVENTS.fetch_or(events, Ordering::AcqRel);
        METER_WAKE.writer().write(());
    }

    /// The flash has so long to deliver its content before the board starts without what is missing: the configuration
    /// comes first, 25 ms after an erase that a reset left running, 400 ms. The state takes 0.1 s more at most, and in
    /// that case it is in RAM as well. The watchdog bites after 680 ms at the earliest.
    const LOAD_LIMIT_MS: u32 = 450;
    /// The same after a loss of power, which may have cut an erase off: sequential-storage erases that sector anew as it reads,
    /// 400 ms, or passes over what is left in it byte by byte, 0.13 s. A chip that does not answer is waited for no longer than
    /// above. The tasks' own check-in begins at [`START_LIMIT`], and this task's goes on while it waits for the flash.
    const MENDING_LOAD_LIMIT_MS: u32 = 900;
    /// Every task has to check in from here on, started or not.
    const START_LIMIT: Duration = Duration::from_ticks(1_000_000);
    #[expect(clippy::cast_possible_truncation, reason = "20 ms")]
    const METER_POLL_MS: u32 = design_parameters::METER_POLL_MS as u32;
    /// The meter's steps lie halfway between two ticks: its priority is the higher one, and setting the chip up takes
    /// 0.6 ms, by which a frame would be late.
    const METER_PHASE_MS: u32 = TICK_MS / 2;
    /// Ten seconds: a conversion adds a little noise to the energy.
    const TEMPERATURE_EVERY_POLLS: u32 = 500;
    /// The result is fetched this long before the next conversion, when even a slow one has ended.
    const TEMPERATURE_FETCH_POLLS_BEFORE: u32 = 400;
    const TICK_MS: u32 = 10;
    /// Idle looks for late tasks at most this often.
    const IDLE_LOOK_US: u32 = 10_000;
    /// Time between two tries to wake a flash that has not answered.
    const FLASH_RETRY_MS: u32 = 1_000;
    /// Time between two log records when nothing happens.
    const LOG_PERIOD_MS: u32 = 10_000;
    /// Stack that has to stay free.
    const STACK_RESERVE: usize = 8 * 1024;

    /// What the two tasks of priority 1 share.
    pub struct Administration {
        store: ConfigurationStore,
        /// To the storage task, until it is done: save, restore or clear the log.
        request: Option<Command>,
        /// To it as well, and first: the configuration is damaged, what is stored is to be loaded.
        is_damaged: bool,
        /// Generation of the configuration that the flash holds.
        saved: Option<u32>,
        flash_counters: [u32; 5],
    }

    impl Administration {
        /// The settings show the factors in use, or a client could not set those that they show.
        fn keep_key_factors(&mut self, factors: KeyFactors) {
            let mut staged = *self.store.active();
            if staged.key_factors != factors {
                staged.key_factors = factors;
                let _ = self.store.commit(staged);
            }
        }
    }

    #[shared]
    struct Shared {
        edges: Edges,
        meter_line: MeterLine,
        meter_link: MeterLink,
        port: Port,
        center: Center,
        administration: Administration,
    }

    #[local]
    struct Local {
        watchdog: Watchdog,
        characters_in: spsc::Producer<'static, Character>,
        characters_out: spsc::Consumer<'static, Character>,
        meter: Meter,
        converter: Converter,
        analog: Analog,
        lines: Lines,
        storage: Storage,
        previous: Previous,
    }

    #[init(local = [characters: spsc::Queue<Character, QUEUE_LENGTH> = spsc::Queue::new()])]
    fn init(mut cx: init::Context) -> (Shared, Local) {
        let store = ConfigurationStore::default();
        let configuration = *store.active();
        let board = Board::start(cx.device, &configuration);
        Mono::start(cx.core.SYST, clock::CORE_HZ);
        // SAFETY: the exception is not enabled for anybody yet. Below the range edge and RS485: the timer queue's
        // work must not delay a time stamp or cost a character. RTIC's 5 priorities are the top 5 of the 16.
        unsafe {
            cx.core.SCB.set_priority(
                cortex_m::peripheral::scb::SystemHandler::SysTick,
                board::SYSTICK_PRIORITY,
            );
        }

        let now = time::now();
        let previous = board.previous;
        let identity = identity::identity(&previous);
        let mut center = Center::new(configuration, board.can, identity, now);
        for code in identity::lasting(&previous) {
            center.conditions.happened.set(code, true);
        }
        report(&previous);
        let meter_config = center.measurement.meter_config(&configuration);
        let channel = MeterChannel::new(meter_config);
        let (characters_in, characters_out) = cx.local.characters.split();

        let shared = Shared {
            edges: board.edges,
            meter_line: board.meter_line,
            meter_link: MeterLink {
                report: MeterReport::default(),
                health: meter::Health::default(),
                in_self_test: false,
                temperature: None,
                storms: 0,
                latency_us: 0,
                bridge: GapBridge::UNKNOWN,
                calibration: None,
            },
            port: board.rs485,
            center,
            administration: Administration {
                store,
                request: None,
                is_damaged: false,
                saved: None,
                flash_counters: [0; 5],
            },
        };
        let local = Local {
            watchdog: board.watchdog,
            characters_in,
            characters_out,
            converter: Converter::new(board.i2c, &configuration.converter),
            meter: Meter::new(board.meter_spi, channel),
            analog: board.analog,
            lines: board.lines,
            storage: Storage::new(board.flash_spi),
            previous,
        };
        // The queue is empty: it takes one.
        let _ = storage::spawn();
        retain::note_stage(Stage::Running);
        (shared, local)
    }

    fn report(previous: &Previous) {
        defmt::info!(
            "start {}: {}, stage {}, late tasks {=u8:08b}",
            previous.resets,
            previous.cause.describe(),
            previous.stage,
            previous.late_tasks
        );
        if let Some(fault) = previous.fault {
            defmt::error!(
                "last run ended with {}: {=[u8]:a}:{=u32}",
                fault,
                previous.panic_file,
                previous.panic_line
            );
        }
    }

    /// Feeds the watchdog when every task has checked in, and sleeps.
    #[idle(local = [watchdog])]
    fn idle(cx: idle::Context) -> ! {
        let mut check_in = CheckIn::default();
        let mut noted = 0;
        let mut all = false;
        let start = time::now();
        check_in.enable(Task::Storage, start);
        let mut looked = time::micros();
        loop {
            // Every interrupt ends the sleep, a thousand of them a second; who is late is late by more than this.
            if time::micros().wrapping_sub(looked) < IDLE_LOOK_US {
                cortex_m::asm::wfi();
                continue;
            }
            looked = time::micros();
            let now = time::now();
            if !all && elapsed(start, now) >= START_LIMIT {
                all = true;
                for task in Task::ALL {
                    check_in.enable(task, now);
                }
            }
            let seen = ALIVE.swap(0, Ordering::Relaxed);
            for task in Task::ALL {
                if seen & (1 << task as u32) != 0 {
                    check_in.check_in(task, now);
                }
            }
            let late = match check_in.may_feed(now) {
                Ok(()) => {
                    cx.local.watchdog.feed();
                    0
                }
                Err(late) => late.bits(),
            };
            if late != noted {
                noted = late;
                retain::note_late_tasks(late);
                if late != 0 {
                    defmt::warn!("late tasks {=u8:08b}", late);
                }
            }
            cortex_m::asm::wfi();
        }
    }

    /// Range-flag edge. Deadline 5 µs: a miss makes the edge's time stamp late by as much.
    #[task(binds = EXTI0, priority = 5, shared = [edges])]
    fn range_edge(mut cx: range_edge::Context) {
        let now = time::now();
        cx.shared.edges.lock(|edges| edges.on_interrupt(now));
        ask_meter(event::EDGE);
    }

    /// IRQ of the meter. Deadline 20 ms, the next poll: it only backs the poll up.
    #[task(binds = EXTI4, priority = 3, shared = [edges, meter_line])]
    fn meter_interrupt(cx: meter_interrupt::Context) {
        let now = time::now();
        (cx.shared.edges, cx.shared.meter_line).lock(|edges, line| line.on_interrupt(edges, now));
        ask_meter(event::IRQ);
    }

    /// The meter's owner. Deadline 100 µs from a range edge to the latching of AENERGY: a miss lets counts of the new
    /// range carry the old range's scale, 48 mC per 100 µs from 600 to 60 A, corrected by the known delay. The poll's
    /// deadline is 20 ms; nothing is lost before the accumulator is half full, 469 s.
    #[task(priority = 3, local = [meter], shared = [edges, meter_line, meter_link])]
    async fn meter_owner(
        mut cx: meter_owner::Context,
        charge: Option<Nanocoulombs>,
        started: Instant,
    ) {
        let meter = cx.local.meter;
        let Some(mut wake) = METER_WAKE.try_take_reader() else {
            return;
        };
        meter.channel().start(started);
        if let Some(charge) = charge {
            meter
                .channel()
                .restore(charge, Nanocoulombs::ZERO, Nanocoulombs::ZERO);
        }
        let mut next_poll = next_on_grid(METER_PHASE_MS);
        if meter.is_fresh() {
            cx.shared.meter_link.lock(|link| link.in_self_test = true);
            pace::until(next_poll).await;
            if let Some(start) = meter.start_self_test() {
                for _ in 0..meter::SELF_TEST_MS / TICK_MS {
                    next_poll += TICK_MS.millis();
                    pace::until(next_poll).await;
                    alive(Task::Meter);
                }
                meter.finish_self_test(start);
            }
        }
        cx.shared.meter_link.lock(|link| link.in_self_test = false);
        pace::until(next_poll).await;
        let mut polls_to_temperature = 0_u32;
        let (mut edge, mut interrupt, mut verify, mut poll) = (false, false, true, true);
        let (mut convert, mut fetch) = (false, false);
        let mut edge_at = None;
        // A storm's beginning and end have snapshots of their own, so that the time without edges stands alone.
        let (mut bound, mut storms_seen) = (false, 0);
        // The newest reading waits for another one.
        let mut waits = false;
        loop {
            let now = time::now();
            let events = METER_EVENTS.swap(0, Ordering::AcqRel);
            if events & event::EDGE != 0 {
                edge = true;
                let (last_edge, storms) = cx
                    .shared
                    .edges
                    .lock(|edges| (edges.last_edge(), edges.storms()));
                edge_at = edge_at.or(last_edge);
                bound |= core::mem::replace(&mut storms_seen, storms) != storms;
            }
            interrupt |= events & event::IRQ != 0;
            let (bridge, calibration) = cx
                .shared
                .meter_link
                .lock(|link| (link.bridge, link.calibration.take()));
            if let Some(calibration) = &calibration {
                meter.channel().set_calibration(calibration);
            }
            // Without a counting chip there is nothing to hand over.
            edge &= meter.is_counting();
            edge_at = edge_at.filter(|_| edge);
            let mut worked = true;
            if edge && (core::mem::take(&mut bound) || meter.may_snapshot(now)) {
                edge = false;
                waits = meter.snapshot(
                    |at| cx.shared.edges.lock(|edges| edges.history(at)),
                    &bridge,
                );
                publish(meter, &mut cx.shared.meter_link, edge_at.take());
            } else if verify {
                verify = false;
                let mode_is_right = meter.verify(now);
                // Only right after MODE was seen to be right: the write would hide that a reset has cleared it.
                convert = mode_is_right && polls_to_temperature == 0;
            } else if convert {
                convert = false;
                polls_to_temperature = TEMPERATURE_EVERY_POLLS;
                meter.start_temperature();
            } else if fetch && !poll {
                fetch = false;
                let temperature = meter.temperature();
                cx.shared
                    .meter_link
                    .lock(|link| link.temperature = temperature);
            } else if poll {
                poll = false;
                polls_to_temperature = polls_to_temperature.saturating_sub(1);
                fetch = polls_to_temperature == TEMPERATURE_FETCH_POLLS_BEFORE;
                if meter.is_counting() {
                    waits = meter.snapshot(
                        |at| cx.shared.edges.lock(|edges| edges.history(at)),
                        &bridge,
                    );
                }
                publish(meter, &mut cx.shared.meter_link, None);
                alive(Task::Meter);
            } else if interrupt {
                cx.shared.meter_line.lock(|line| line.clear_pending());
                let status = meter.take_status();
                defmt::debug!("meter: {}", status);
                interrupt = (&mut cx.shared.edges, &mut cx.shared.meter_line)
                    .lock(|edges, line| line.still_low(edges, now));
            } else {
                worked = false;
            }
            if worked {
                // The other interrupts of this priority have their turn between two steps.
                pace::yield_now().await;
                continue;
            }

            let masked = cx.shared.edges.lock(|edges| edges.is_masked());
            let until = if edge || masked || waits {
                // The rest after a storm ends 1 … 2 ms after its beginning.
                pace::now() + 1.millis()
            } else {
                next_poll
            };
            // A time-out is one of the two expected outcomes.
            let _ = pace::until_event(until, wake.wait()).await;
            let now = time::now();
            let (found, irq, storms) =
                (&mut cx.shared.edges, &mut cx.shared.meter_line).lock(|edges, line| {
                    let found = edges.poll(now);
                    let irq = line.poll(edges, now);
                    (found, irq, edges.storms().saturating_add(line.storms()))
                });
            cx.shared.meter_link.lock(|link| link.storms = storms);
            edge |= found | core::mem::take(&mut waits);
            bound |= found;
            interrupt |= irq;
            if pace::has_come(next_poll) {
                (verify, poll) = (true, true);
                next_poll += METER_POLL_MS.millis();
                if pace::has_come(next_poll) {
                    next_poll = next_on_grid(METER_PHASE_MS);
                }
            }
        }
    }

    /// Hands the meter's state to the measurement, with the age of the edge that asked for it.
    fn publish(meter: &Meter, link: &mut impl rtic::Mutex<T = MeterLink>, asked: Option<Instant>) {
        let (report, health) = (meter.report(), meter.health());
        let latency = asked
            .zip(report.at)
            .map_or(0, |(asked, at)| elapsed(asked, at).as_ticks());
        link.lock(|link| {
            link.report = report;
            link.health = health;
            link.latency_us = link
                .latency_us
                .max(u32::try_from(latency).unwrap_or(u32::MAX));
        });
    }

    /// The converter's owner. Deadline one conversion, 31 ms: a miss costs a sample of the average; stale after three.
    ///
    /// At the lowest priority, for it polls the bus for 0.1 ms at a time, and the CAN frames have no such time to spare.
    #[task(priority = 1, local = [converter], shared = [center, edges])]
    async fn conversion(mut cx: conversion::Context) {
        let converter = cx.local.converter;
        let mut pace = PollPace::default();
        loop {
            alive(Task::Conversion);
            let (channel, config) = cx.shared.center.lock(|center| {
                (
                    center.configuration.front_end.channel(),
                    center.configuration.converter,
                )
            });
            if channel != Channel::Ads1100 {
                pace::at_least(TICK_MS).await;
                continue;
            }
            let started = time::now();
            let outcome = match converter.start(&config) {
                Ok(()) => finish(converter, &config, &mut pace).await,
                Err(fault) => Err(fault),
            };
            let finished = time::now();
            let history = cx.shared.edges.lock(|edges| edges.history(finished));
            let failed = outcome.is_err();
            cx.shared.center.lock(|center| {
                center.converter = converter.counters();
                match outcome {
                    Ok(Some(code)) => {
                        let configuration = config.expected_configuration();
                        center.on_conversion(
                            &ConverterSample {
                                started,
                                finished,
                                configuration,
                                code,
                            },
                            &history,
                        );
                    }
                    Ok(None) => {}
                    Err(fault) => center.on_converter_fault(fault, finished),
                }
            });
            if failed {
                // A bus that fails at once must not take the time of those that work.
                pace::at_least(TICK_MS).await;
            }
        }
    }

    /// Polls the conversion under way from shortly before its end to the last at which it may end.
    async fn finish(
        converter: &mut Converter,
        config: &core_logic::converter::ConverterConfig,
        pace: &mut PollPace,
    ) -> Result<Option<i16>, ConverterFault> {
        let first_ms = pace.first_ms(config.data_rate);
        pace::at_least(first_ms).await;
        let limit_ms = converter
            .longest_ms()
            .max(PollPace::limit_ms(config.data_rate));
        for waited_ms in first_ms..=limit_ms {
            match converter.poll(config)? {
                Progress::Busy => pace::until(pace::now() + 1.millis()).await,
                Progress::Discarded => {
                    // Another conversion may have ended.
                    pace.unknown();
                    return Ok(None);
                }
                Progress::Ready(sample) => {
                    pace.ended(waited_ms);
                    return Ok(Some(sample.code));
                }
            }
        }
        pace.unknown();
        converter.on_timeout();
        Err(ConverterFault::NoAnswer)
    }

    /// Environment, diagnosis, permit and CAN, every 10 ms with at most 0.5 ms of jitter. A miss: a late frame.
    #[task(priority = 2, local = [analog, lines], shared = [center, edges, meter_link])]
    async fn tick(mut cx: tick::Context) {
        let mut next = next_on_grid(0);
        loop {
            pace::until(next).await;
            next += TICK_MS.millis();
            alive(Task::Tick);
            time::extend();
            let now = time::now();
            let history = cx.shared.edges.lock(|edges| edges.history(now));
            let readings = cx.local.analog.begin_tick();
            let levels = cx.local.lines.levels();
            let mut link = cx.shared.meter_link.lock(|link| *link);
            let permit = cx
                .shared
                .center
                .lock(|center| center.tick(now, &history, levels, &readings, &mut link));
            cx.local.analog.end_tick();
            cx.shared.meter_link.lock(|shared| {
                shared.bridge = link.bridge;
                if link.calibration.is_some() {
                    shared.calibration = link.calibration;
                }
            });
            cx.local.lines.permit(permit);
            alive(Task::Environment);
        }
    }

    /// A mailbox has become free. Deadline: the next frame.
    #[task(binds = CAN1_TX, priority = 2, shared = [center])]
    fn can_transmitted(mut cx: can_transmitted::Context) {
        cx.shared
            .center
            .lock(|center| center.bus.on_transmitted(time::now()));
    }

    /// A frame for this board. Deadline 0.7 ms, three frames of the shortest kind: a miss loses one, counted.
    #[task(binds = CAN1_RX0, priority = 2, shared = [center])]
    fn can_received(mut cx: can_received::Context) {
        cx.shared
            .center
            .lock(|center| center.on_received(time::now()));
    }

    /// Bus-off.
    #[task(binds = CAN1_SCE, priority = 2, shared = [center])]
    fn can_error(mut cx: can_error::Context) {
        cx.shared
            .center
            .lock(|center| center.bus.on_error(time::now()));
    }

    /// RS485 characters. Deadline 95 µs, one character: a miss spoils the request, which is counted. Above the meter's
    /// owner, whose steps may take longer than that.
    #[task(binds = USART2, priority = 4, local = [characters_in], shared = [port])]
    fn rs485_character(mut cx: rs485_character::Context) {
        if cx
            .shared
            .port
            .lock(|port| port.on_interrupt(cx.local.characters_in))
        {
            RS485_WAKE.writer().write(());
        }
    }

    /// The Modbus server. No deadline but the client's patience.
    #[task(priority = 1, local = [characters_out], shared = [port, center, administration, edges, meter_line, meter_link])]
    async fn rs485(mut cx: rs485::Context) {
        let Some(mut wake) = RS485_WAKE.try_take_reader() else {
            return;
        };
        // Nobody waits any more for an answer to what came before the start.
        while cx.local.characters_out.dequeue().is_some() {}
        let mut server = Server::new(time::now());
        let mut last_command = 0;
        let mut errors = 0;
        let mut generation = 0;
        let mut checked = time::now();
        loop {
            alive(Task::Rs485);
            let wait_ms = server
                .ends_at()
                .map_or(100, |end| until_ms(end, time::now()).clamp(1, 100));
            let _ = pace::until_event(pace::after(wait_ms), wake.wait()).await;
            while let Some(character) = cx.local.characters_out.dequeue() {
                let (byte, line_errors, at) = character.unpack();
                server.on_character(byte, line_errors, at);
            }
            let now = time::now();
            if server.ends_at().is_some_and(|end| now >= end) {
                let mut readings = Readings::default();
                fill(&mut cx, &server, last_command, &mut readings);
                let served = cx.shared.administration.lock(|administration| {
                    readings.configuration_generation = administration.store.generation();
                    readings.configuration_crc = administration.store.crc();
                    readings.configuration_saved =
                        administration.saved == Some(administration.store.generation());
                    readings.storage_busy = administration.request.is_some();
                    readings.configuration_in_transfer = matches!(
                        administration.request,
                        Some(Command::Save | Command::Restore)
                    );
                    readings.flash_counters = administration.flash_counters;
                    server.serve(now, &readings, &mut administration.store)
                });
                if let Some(served) = served {
                    let earliest = served.reply.map(|(_, earliest)| earliest);
                    if let Some(Event::Command(command)) = served.event {
                        last_command = u16::from(Command::KEY) << 8 | command as u16;
                        let is_begun = carry_out(
                            &mut cx.shared.center,
                            &mut cx.shared.administration,
                            command,
                        );
                        if !is_begun && earliest.is_some() {
                            server.refuse();
                        }
                    }
                    if let Some(earliest) = earliest {
                        pace::at_least(until_ms(earliest, time::now())).await;
                        cx.shared.port.lock(|port| port.send(server.reply()));
                    }
                }
            }

            let total = server.counters().communication_errors;
            let found = cx.shared.center.lock(|center| {
                center.conditions.rs485_errors |= total != errors;
                center.measurement.take_found()
            });
            errors = total;
            let check = elapsed(checked, now) >= Duration::from_ticks(1_000_000);
            if check {
                checked = now;
            }
            let mut refused = found.is_some();
            let (active, crc, changed, mut damaged) =
                cx.shared.administration.lock(|administration| {
                    let store = &mut administration.store;
                    let damaged = check && store.stage().is_err();
                    administration.is_damaged |= damaged;
                    if let Some(found) = found
                        && let Ok(active) = store.stage()
                    {
                        let mut staged = *active;
                        found.store(&mut staged);
                        refused = store.commit(staged).is_err();
                    }
                    let changed = store.generation() != generation;
                    generation = store.generation();
                    (*store.active(), store.crc(), changed, damaged)
                });
            if refused {
                defmt::warn!("calibration not taken: {}", found);
                cx.shared
                    .center
                    .lock(|center| center.measurement.found_was_refused());
            }
            // Until the stored one is there the measurement goes on with its own copy.
            let is_sound = !damaged;
            let mut renew = changed && is_sound;
            if check && !changed {
                let damage = find_damage(&mut cx.shared.center, crc);
                renew = is_sound && matches!(damage, Some(Damage::Configuration));
                damaged |= damage.is_some();
            }
            cx.shared.center.lock(|center| {
                if renew {
                    center.set_configuration(&active);
                    center.identity.configuration_crc = crc;
                }
                if check {
                    center.conditions.configuration_corrupt = damaged;
                }
            });
            if is_sound && (check || renew) {
                hand_limits(&mut cx, &active);
            }
        }
    }

    /// Whole milliseconds until `at`, rounded up; 0 when it has passed.
    fn until_ms(at: Instant, now: Instant) -> u32 {
        u32::try_from(elapsed(now, at).as_ticks().div_ceil(1_000)).unwrap_or(u32::MAX)
    }

    /// What the check once a second finds in the measurement.
    enum Damage {
        /// Its configuration is not the store's any more: to be renewed.
        Configuration,
        /// Its factors did not follow from it, and have been replaced.
        Factors,
    }

    /// Looks for damage in the measurement's configuration, of which `crc` is right, and its factors. The CRC takes 0.5 ms and
    /// the factors 0.15 ms, which the tick must not wait for. Not inlined: the image is 228 bytes smaller.
    #[inline(never)]
    fn find_damage(center: &mut impl rtic::Mutex<T = Center>, crc: u32) -> Option<Damage> {
        let (copy, basis) =
            center.lock(|center| (center.configuration, center.measurement.basis()));
        if copy.crc() != crc {
            return Some(Damage::Configuration);
        }
        let prepared = prepare(&copy, &basis);
        center
            .lock(|center| center.measurement.check_factors(&basis, &prepared))
            .then_some(Damage::Factors)
    }

    /// Hands the lines' owners their limits; at each check too, for they keep copies.
    fn hand_limits(cx: &mut rs485::Context<'_>, active: &Configuration) {
        cx.shared
            .edges
            .lock(|edges| edges.set_config(active.edge_storm));
        cx.shared
            .meter_line
            .lock(|line| line.set_config(active.meter_line_storm));
    }

    /// Fills in what a client can read, but for the configuration.
    fn fill(
        cx: &mut rs485::Context<'_>,
        server: &Server,
        last_command: u16,
        readings: &mut Readings,
    ) {
        let now = time::now();
        readings.last_command = last_command;
        let link = cx.shared.meter_link.lock(|link| *link);
        cx.shared.center.lock(|center| {
            center.fill(readings);
            identity::fill(&center.identity, readings);
            let free = usize::try_from(center.identity.stack_free).unwrap_or(0);
            readings.stack_high_water =
                u32::try_from(stack::BYTES.saturating_sub(free)).unwrap_or(u32::MAX);
        });
        readings.uptime_s = u32::try_from(now.as_ticks() / 1_000_000).unwrap_or(u32::MAX);
        readings.snapshot_latency_us = link.latency_us;
        let health = link.health;
        readings.meter_counters = [
            health.repeated,
            health.checksum_failures,
            health.resets,
            link.report.rejected,
            health.read_back_failures,
        ];
        let counters = server.counters();
        readings.rs485_counters = [
            counters.messages,
            counters.communication_errors,
            counters.exceptions,
            counters.server_messages,
            counters.no_responses,
            counters.character_overruns,
            counters.busy,
            counters.missed,
            counters.character_gaps,
        ];
    }

    /// Carries an order out, or hands it to the storage task. Whether it was not refused at once.
    fn carry_out(
        center: &mut impl rtic::Mutex<T = Center>,
        administration: &mut impl rtic::Mutex<T = Administration>,
        command: Command,
    ) -> bool {
        let order = match command {
            Command::ZeroNow => Order::ZeroNow,
            Command::StartKeyCalibration => Order::KeyCalibration,
            Command::SupplyPointAtZero => Order::SupplyPointAtZero,
            Command::SupplyPointAtCurrent => Order::SupplyPointAtCurrent,
            Command::FinishSupplyCalibration => Order::FinishSupplyCalibration,
            Command::Abort => Order::Abort,
            Command::ClearDiagnoses => Order::ClearDiagnoses,
            Command::Save | Command::Restore | Command::ClearLog | Command::FactoryDefaults => {
                let state = administration.lock(|administration| {
                    if command == Command::FactoryDefaults {
                        administration.store.factory_defaults();
                        CommandState::Done
                    } else {
                        administration.request = Some(command);
                        CommandState::Running
                    }
                });
                center.lock(|center| center.measurement.note_command(state, 0));
                return true;
            }
        };
        center.lock(|center| {
            let Center {
                configuration,
                measurement,
                ..
            } = center;
            let begun = measurement.order(configuration, order);
            if let Err(refusal) = begun {
                defmt::info!("order refused: {}", refusal);
            }
            begun.is_ok()
        })
    }

    /// Reads the flash, starts the measurement, and then keeps configuration, charge and log. No deadline; a loss of
    /// power costs at most what the save policy states.
    #[task(priority = 1, local = [storage, previous], shared = [center, administration, meter_link])]
    async fn storage(cx: storage::Context) {
        pace::paced(async |pace| store(cx, pace).await).await;
    }

    async fn store(mut cx: storage::Context<'_>, pace: Pace<'_>) -> Infallible {
        let storage = cx.local.storage;
        let (mut stored, mut state) = (Stored::Refused, Stored::Refused);
        let answers_by = pace::now() + LOAD_LIMIT_MS.millis();
        let load = async {
            // A chip that answers late or wrongly once, or still erases, must not cost the calibration.
            while !storage.start(pace).await {
                if pace::has_come(answers_by) {
                    return;
                }
                alive(Task::Storage);
                pace.pause(2).await;
            }
            stored = storage.configuration(pace).await;
            state = storage.state(pace).await;
        };
        // What has not come in time counts as refused.
        let limit_ms = if cx.local.previous.cause.may_have_cut_off() {
            MENDING_LOAD_LIMIT_MS
        } else {
            LOAD_LIMIT_MS
        };
        pace.limited(limit_ms, pin!(load)).await;
        if !storage.is_ready() {
            defmt::error!("flash not ready");
        }
        let now = time::now();

        let configuration = cx.shared.administration.lock(|administration| {
            if let Stored::Value(configuration) | Stored::Older(configuration) = &stored {
                // It was checked when it was decoded.
                let _ = administration.store.load(*configuration);
                administration.saved = Some(administration.store.generation());
            }
            *administration.store.active()
        });
        let start = retained_state(cx.local.previous, &state, &configuration);
        // The next start must not find nothing, nor what is older than this one's.
        let mut first_save = !start.is_in_flash;
        let charge = start.state.map(|state| state.charge_total);
        let configuration = cx.shared.administration.lock(|administration| {
            if let Some(state) = &start.state {
                administration.keep_key_factors(state.key_factors);
            }
            *administration.store.active()
        });
        let crc = configuration.crc();
        let calibration = cx.shared.center.lock(|center| {
            center.identity.configuration_crc = crc;
            center.conditions.flash_fault |= start.is_refused;
            center.conditions.flash_missing = !storage.is_ready();
            if matches!(stored, Stored::Refused) {
                center
                    .conditions
                    .happened
                    .set(Code::ConfigurationDefault, true);
            }
            center.resume(
                configuration,
                start.state.as_ref(),
                start.slots,
                start.loss,
                now,
            )
        });
        cx.shared
            .meter_link
            .lock(|link| link.calibration = calibration);
        defmt::info!("configuration {=u32:08x}, charge {}", crc, charge);
        // Each is spawned once, here.
        let _ = meter_owner::spawn(charge, now);
        let _ = conversion::spawn();
        let _ = tick::spawn();
        // Not before its address and what it would change are loaded.
        let _ = rs485::spawn();

        let mut policy = SavePolicy::new(now, charge.unwrap_or(Nanocoulombs::ZERO));
        let mut since_log_ms = 0;
        let mut since_start_ms = 0;
        let mut clearing = false;
        loop {
            let turn_ms = if clearing { 10 } else { 100 };
            pace.pause(pace::whole(turn_ms)).await;
            alive(Task::Storage);
            since_log_ms += turn_ms;
            since_start_ms += turn_ms;
            if since_start_ms >= FLASH_RETRY_MS {
                since_start_ms = 0;
                // What it holds is read with "restore" and at the next start; what is to be saved goes there.
                storage.start(pace).await;
            }
            clearing = serve(
                storage,
                pace,
                &mut cx.shared.center,
                &mut cx.shared.administration,
            )
            .await;
            let now = time::now();
            let (state, save) = cx.shared.center.lock(|center| {
                (
                    center.measurement.retained(0),
                    center.configuration.save_policy,
                )
            });
            if (first_save || policy.due(&save, now, state.charge_total))
                && storage.save_state(pace, &state).await.is_ok()
            {
                first_save = false;
                policy.saved(now, state.charge_total);
            }
            // A log that is being cleared gets its next record afterwards.
            let due = !clearing
                && (since_log_ms >= LOG_PERIOD_MS
                    || cx.shared.center.lock(|center| center.log_due));
            if due {
                since_log_ms = 0;
                let record = cx.shared.center.lock(|center| {
                    center.log_due = false;
                    let boot = center.identity.boots;
                    center.measurement.log_record(&center.configuration, boot)
                });
                storage.append(pace, &record).await;
            }
            supervise(
                storage,
                &mut cx.shared.center,
                &mut cx.shared.administration,
            );
        }
    }

    /// What to go on with.
    struct Start {
        state: Option<RetainedState>,
        slots: RetainSlots,
        /// Bound on what the reset has cost.
        loss: Nanocoulombs,
        /// The state is the flash's newest.
        is_in_flash: bool,
        /// There may have been a state, and it cannot be used.
        is_refused: bool,
    }

    /// The slots' state, else the one of the flash, which the policy of `configuration` wrote.
    fn retained_state(
        previous: &Previous,
        stored: &Stored<RetainedState>,
        configuration: &Configuration,
    ) -> Start {
        let mut start = Start {
            state: None,
            slots: RetainSlots::empty(),
            loss: Nanocoulombs::ZERO,
            is_in_flash: false,
            is_refused: false,
        };
        match (
            RetainSlots::recover(&retain::slot(Slot::A), &retain::slot(Slot::B)),
            stored,
        ) {
            (Ok((state, slots)), _) => {
                start.state = Some(state);
                start.slots = slots;
                start.loss = identity::loss_over_reset(previous, configuration);
            }
            (Err(_), Stored::Value(state) | Stored::Older(state)) => {
                start.state = Some(RetainedState {
                    // It may be older than the last "save": what was saved is in force.
                    key_factors: configuration.key_factors,
                    ..*state
                });
                start.loss = identity::loss_over_power_off(configuration);
                if matches!(stored, Stored::Older(_)) {
                    // A save interval more.
                    start.loss = start.loss.saturating_add(start.loss);
                }
                start.is_in_flash = true;
            }
            (Err(_), Stored::Refused) => {
                // Nobody knows what is missing.
                start.loss = Nanocoulombs(i64::MAX);
                start.is_refused = true;
            }
            (Err(_), Stored::Nothing) => {}
        }
        start
    }

    /// Save, restore, or the next sector of the log to be cleared; whether there are more of them.
    async fn serve(
        storage: &mut Storage,
        pace: Pace<'_>,
        center: &mut impl rtic::Mutex<T = Center>,
        administration: &mut impl rtic::Mutex<T = Administration>,
    ) -> bool {
        let (request, is_damaged) = administration.lock(|administration| {
            let own = administration.is_damaged.then_some(Command::Restore);
            (own.or(administration.request), own.is_some())
        });
        let mut defaulted = false;
        let done = match request {
            None => return false,
            Some(Command::Save) => {
                let staged = administration.lock(|administration| {
                    let store = &administration.store;
                    store.stage().map(|active| (*active, store.generation()))
                });
                // A damaged one must not replace the one that is to be loaded again.
                if let Ok((configuration, generation)) = staged {
                    let done = storage
                        .save_configuration(pace, &configuration)
                        .await
                        .is_ok();
                    if done {
                        administration
                            .lock(|administration| administration.saved = Some(generation));
                    }
                    done
                } else {
                    false
                }
            }
            Some(Command::Restore) => {
                let stored = storage.configuration(pace).await;
                let is_ready = storage.is_ready();
                let in_use = center.lock(|center| center.measurement.retained(0).key_factors);
                administration.lock(|administration| {
                    let store = &mut administration.store;
                    let is_lost = store.stage().is_err();
                    let mut done = false;
                    if let Stored::Value(configuration) | Stored::Older(configuration) = stored {
                        done = store.load(configuration).is_ok();
                        administration.saved = Some(store.generation());
                    } else if is_lost && is_ready {
                        // As at a start. A chip that does not answer may still have one.
                        store.factory_defaults();
                        defaulted = true;
                    }
                    if is_lost {
                        administration.keep_key_factors(in_use);
                    }
                    done
                })
            }
            // Of the three there is only this one left: the log is to be cleared.
            Some(_) => match storage.clear_log_sector(pace).await {
                Ok(true) => return true,
                Ok(false) => true,
                Err(()) => false,
            },
        };
        let state = if done {
            CommandState::Done
        } else {
            CommandState::Failed
        };
        center.lock(|center| {
            if !is_damaged {
                center.measurement.note_command(state, 0);
            }
            if defaulted {
                center
                    .conditions
                    .happened
                    .set(Code::ConfigurationDefault, true);
            }
        });
        administration.lock(|administration| {
            if is_damaged {
                administration.is_damaged = false;
            } else if administration.request == request {
                // An order that has come meanwhile is still to be served.
                administration.request = None;
            }
            administration.request == Some(Command::ClearLog)
        })
    }

    /// Once per turn of the storage task: its conditions; once a second the state, and at times the stack.
    fn supervise(
        storage: &mut Storage,
        center: &mut impl rtic::Mutex<T = Center>,
        administration: &mut impl rtic::Mutex<T = Administration>,
    ) {
        let (failed, log_full) = storage.take_conditions();
        let counters = storage.counters();
        let due = center.lock(|center| {
            center.conditions.flash_fault |= failed;
            center.conditions.flash_missing = !storage.is_ready();
            center.conditions.log_full |= log_full;
            center.second_passed()
        });
        administration.lock(|administration| {
            administration.flash_counters = [
                counters.written,
                counters.erased,
                counters.failures,
                counters.refused,
                counters.lost,
            ];
        });
        if !due {
            return;
        }
        // It reads up to 64 KiB, which takes a millisecond: every eighth second, the first one included.
        let look = center.lock(|center| center.seconds() % 8 == 1);
        let used = look.then(stack::high_water_bytes);
        let (current, charge, used) = center.lock(|center| {
            if let Some(used) = used {
                let free = stack::BYTES.saturating_sub(used);
                center.conditions.little_stack = free < STACK_RESERVE;
                center.identity.stack_free = u32::try_from(free).unwrap_or(0);
            }
            let used = stack::BYTES.saturating_sub(center.identity.stack_free as usize);
            (
                center.measurement.current(),
                center.measurement.charge(),
                used,
            )
        });
        defmt::info!(
            "{} {}, {} {}, stack {}",
            current.current,
            current.validity,
            charge.charge,
            charge.validity,
            used
        );
    }
}
