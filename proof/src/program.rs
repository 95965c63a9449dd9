//! Starting other programs with a limit, and what they took.

use std::{
    fs,
    io::Read,
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};

/// Clock ticks in a second in /proc (`getconf CLK_TCK`; 100 on every Linux that this runs on).
const TICKS_PER_S: f64 = 100.0;
/// Between two looks at a running program.
const LOOK: Duration = Duration::from_millis(10);

/// What a program took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Taken {
    /// Of the wall clock.
    pub seconds: f64,
    /// Of the processors, its own children not counted; as of the last look, at most a few hundredths short.
    pub processor_s: f64,
}

/// Of the wall clock, over the limit in processor time: other programs may run beside.
const PATIENCE: u32 = 10;

/// Runs to the end; an error with what it said if it fails or takes more processor time than `limit`, or ten times that of
/// the wall clock.
pub fn run(command: &mut Command, limit: Duration) -> Result<Taken> {
    let name = command.get_program().to_string_lossy().into_owned();
    let start = Instant::now();
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| format!("starting {name}"))?;
    let said = collect(child.stdout.take());
    let errors = collect(child.stderr.take());
    let stat = format!("/proc/{}/stat", child.id());
    let mut processor_s = 0.0;
    let status = loop {
        if let Some(now) = fs::read_to_string(&stat).ok().and_then(|s| processor(&s)) {
            processor_s = now;
        }
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if processor_s > limit.as_secs_f64() || start.elapsed() > limit * PATIENCE {
            child.kill()?;
            child.wait()?;
            bail!("took longer than {} s of processor time", limit.as_secs());
        }
        thread::sleep(LOOK);
    };
    let seconds = start.elapsed().as_secs_f64();
    let _stdout = said.join();
    if !status.success() {
        let errors = errors.join().unwrap_or_default();
        let lines: Vec<&str> = errors.trim_end().lines().collect();
        let last = lines[lines.len().saturating_sub(6)..].join(" | ");
        bail!("{status}: {last}");
    }
    Ok(Taken {
        seconds,
        processor_s,
    })
}

/// User and system time, fields 14 and 15 of proc(5); the name before them may hold blanks and parentheses.
fn processor(stat: &str) -> Option<f64> {
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let user: f64 = fields.next()?.parse().ok()?;
    let system: f64 = fields.next()?.parse().ok()?;
    Some((user + system) / TICKS_PER_S)
}

fn collect(pipe: Option<impl Read + Send + 'static>) -> thread::JoinHandle<String> {
    thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(mut pipe) = pipe {
            let _partial = pipe.read_to_end(&mut bytes);
        }
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn a_program_that_fails_or_hangs_is_an_error() {
        let limit = Duration::from_secs(20);
        assert!(run(&mut Command::new("true"), limit).is_ok());
        let failed = run(
            Command::new("sh").args(["-c", "echo why >&2; exit 3"]),
            limit,
        );
        assert!(failed.unwrap_err().to_string().contains("why"));
        let hung = run(Command::new("sleep").arg("20"), Duration::from_millis(5));
        assert!(hung.unwrap_err().to_string().contains("longer"));
    }

    #[test]
    fn processor_time_is_read_behind_any_name() {
        let stat = "12 (a ) b) S 1 2 3 4 5 6 7 8 9 10 250 50 0 0 20 0 1";
        assert_eq!(processor(stat), Some(3.0));
    }
}
