//! Starting other programs with a limit, and what they took.

use std::{
    fs,
    io::{BufRead, BufReader, Read, Write},
    path::{Path, PathBuf},
    process::{Child, ChildStdin, Command, Stdio},
    sync::{Mutex, mpsc},
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
        bail!("{status}: {}", last_lines(&errors));
    }
    Ok(Taken {
        seconds,
        processor_s,
    })
}

/// The last lines of what a program said, in one.
fn last_lines(said: &str) -> String {
    let lines: Vec<&str> = said.trim_end().lines().collect();
    lines[lines.len().saturating_sub(6)..].join(" | ")
}

/// Keeps a Python program running (serve.py).
const SERVE: &str = include_str!("serve.py");

/// A Python program whose processes stay for the next task, each for one at a time.
pub struct Served {
    /// The interpreter.
    python: PathBuf,
    /// Its source; has `main(arguments)`, which returns the exit code.
    program: PathBuf,
    idle: Mutex<Vec<Server>>,
}

impl Served {
    /// None runs yet.
    pub fn new(python: PathBuf, program: PathBuf) -> Self {
        Self {
            python,
            program,
            idle: Mutex::new(Vec::new()),
        }
    }

    /// Its source.
    pub fn program(&self) -> &Path {
        &self.program
    }

    /// As [`run`] does of the same command line, for the time of this task.
    pub fn run(&self, arguments: &[String], limit: Duration) -> Result<()> {
        let there = locked(&self.idle).pop();
        let mut server = match there {
            Some(server) => server,
            None => Server::start(&self.python, &self.program)?,
        };
        // After an error of its own it is not asked again: what it does still is not known.
        let answer = server.ask(arguments, limit)?;
        locked(&self.idle).push(server);
        if answer.code != 0 {
            bail!("exit status: {}: {}", answer.code, last_lines(&answer.said));
        }
        Ok(())
    }
}

/// A line of serve.py.
#[derive(Deserialize)]
struct Answer {
    code: i32,
    said: String,
}

/// A running process; ends with this.
struct Server {
    child: Child,
    requests: ChildStdin,
    replies: mpsc::Receiver<String>,
    errors: Option<thread::JoinHandle<String>>,
}

impl Server {
    fn start(python: &Path, program: &Path) -> Result<Self> {
        let mut command = Command::new(python);
        command.arg("-B").arg("-c").arg(SERVE).arg(program);
        one_thread(&mut command);
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .with_context(|| format!("starting {}", python.display()))?;
        let (Some(requests), Some(stdout)) = (child.stdin.take(), child.stdout.take()) else {
            bail!("{} without pipes", python.display());
        };
        let errors = Some(collect(child.stderr.take()));
        let (to, replies) = mpsc::channel();
        thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if to.send(line).is_err() {
                    return;
                }
            }
        });
        Ok(Self {
            child,
            requests,
            replies,
            errors,
        })
    }

    fn ask(&mut self, arguments: &[String], limit: Duration) -> Result<Answer> {
        let stat = format!("/proc/{}/stat", self.child.id());
        let processor_s = || fs::read_to_string(&stat).ok().and_then(|s| processor(&s));
        let start = Instant::now();
        let before_s = processor_s().unwrap_or(0.0);
        // If it has ended, it says why below.
        let _broken = writeln!(self.requests, "{}", serde_json::to_string(arguments)?);
        loop {
            match self.replies.recv_timeout(LOOK) {
                Ok(line) => {
                    return serde_json::from_str(&line)
                        .with_context(|| format!("no answer of serve.py: {line}"));
                }
                Err(mpsc::RecvTimeoutError::Disconnected) => {
                    let status = self.child.wait()?;
                    let errors = self.errors.take().map(|errors| errors.join());
                    let errors = errors.and_then(Result::ok).unwrap_or_default();
                    bail!("{status}: {}", last_lines(&errors));
                }
                Err(mpsc::RecvTimeoutError::Timeout) => {}
            }
            let took_s = processor_s().unwrap_or(before_s) - before_s;
            if took_s > limit.as_secs_f64() || start.elapsed() > limit * PATIENCE {
                bail!("took longer than {} s of processor time", limit.as_secs());
            }
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ended_itself = self.child.kill();
        let _no_zombie = self.child.wait();
    }
}

/// Libraries that would use every processor for one process.
fn one_thread(command: &mut Command) {
    for variable in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"] {
        command.env(variable, "1");
    }
    command.env("PYBAMM_DISABLE_TELEMETRY", "true");
}

/// What is guarded; a worker that panicked ends the campaign anyway.
pub fn locked<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    match mutex.lock() {
        Ok(guard) => guard,
        Err(poisoned) => poisoned.into_inner(),
    }
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
    fn a_served_program_answers_many_tasks_and_survives_their_ends() {
        const PROGRAM: &str = r#"
import os, subprocess, sys
seen = []
def main(arguments):
    what = arguments[0]
    seen.append(what)
    print("not for the campaign")
    subprocess.run(["sh", "-c", "echo nor this; cat"])
    if what == "count" and len(seen) != int(arguments[1]):
        sys.exit(f"{len(seen)} tasks")
    if what == "fail":
        print("why", file=sys.stderr)
        return 3
    if what == "raise":
        raise ValueError("wrong input")
    if what == "die":
        print("last words", file=sys.__stderr__, flush=True)
        os._exit(7)
    while what == "hang":
        pass
"#;
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("tasks.py");
        fs::write(&program, PROGRAM).unwrap();
        let served = Served::new(PathBuf::from("python3"), program);
        let ask = |words: &[&str], limit_s| {
            let words: Vec<String> = words.iter().map(|&word| word.to_owned()).collect();
            served
                .run(&words, Duration::from_secs_f64(limit_s))
                .map_err(|error| error.to_string())
        };
        assert_eq!(ask(&["count", "1"], 20.0), Ok(()));
        assert_eq!(ask(&["fail"], 20.0), Err("exit status: 3: why".to_owned()));
        let raised = ask(&["raise"], 20.0).unwrap_err();
        assert!(raised.ends_with("ValueError: wrong input"), "{raised}");
        // One process until here.
        assert_eq!(ask(&["count", "4"], 20.0), Ok(()));
        let died = ask(&["die"], 20.0).unwrap_err();
        assert!(died.contains("7") && died.ends_with("last words"), "{died}");
        assert_eq!(ask(&["count", "1"], 20.0), Ok(()));
        let hung = ask(&["hang"], 0.05).unwrap_err();
        assert!(hung.contains("longer"), "{hung}");
        assert_eq!(
            ask(&["count", "2"], 20.0).unwrap_err(),
            "exit status: 1: 1 tasks"
        );
    }

    #[test]
    fn processor_time_is_read_behind_any_name() {
        let stat = "12 (a ) b) S 1 2 3 4 5 6 7 8 9 10 250 50 0 0 20 0 1";
        assert_eq!(processor(stat), Some(3.0));
    }
}
