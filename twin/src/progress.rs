//! How far a command is, for whoever waits at a terminal.

use std::{
    io::{self, IsTerminal, Write},
    sync::{Arc, Condvar, Mutex, PoisonError},
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

/// Nothing is shown before this.
const PATIENCE: Duration = Duration::from_secs(1);
/// Time between two changes of the line.
const PACE: Duration = Duration::from_millis(100);

/// A line on a terminal's standard error that says what is done, how much of it, where that is known, and for how long; elsewhere
/// nothing is written. It goes on by itself, so that a step of which no share can be told is seen to be alive.
#[derive(Debug)]
pub struct Progress {
    state: Arc<(Mutex<State>, Condvar)>,
    shows: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct State {
    share: Option<f64>,
    over: bool,
}

impl Progress {
    /// Begins something that is called `what`, such as "reading log.blf".
    pub fn new(what: impl Into<String>) -> Self {
        let state = Arc::<(Mutex<State>, Condvar)>::default();
        let shows = io::stderr().is_terminal().then(|| {
            let (what, state) = (what.into(), Arc::clone(&state));
            thread::spawn(move || show(&what, &state))
        });
        Self { state, shows }
    }

    /// `share` of it is done, 0 … 1.
    pub fn at(&mut self, share: f64) {
        if self.shows.is_some() {
            let state = self.state.0.lock();
            state.unwrap_or_else(PoisonError::into_inner).share = Some(share);
        }
    }
}

fn show(what: &str, (state, over): &(Mutex<State>, Condvar)) {
    let start = Instant::now();
    let mut shown = String::new();
    let mut wait = PATIENCE;
    let mut now = state.lock().unwrap_or_else(PoisonError::into_inner);
    loop {
        let waited = over.wait_timeout_while(now, wait, |state| !state.over);
        now = waited.unwrap_or_else(PoisonError::into_inner).0;
        if now.over {
            break;
        }
        wait = PACE;
        let text = line(what, now.share, start.elapsed());
        if text != shown {
            // A terminal that cannot be written to is no reason to stop.
            let _ = write!(io::stderr(), "\r\x1b[K{text}");
            let _ = io::stderr().flush();
            shown = text;
        }
    }
    if !shown.is_empty() {
        let _ = write!(io::stderr(), "\r\x1b[K");
    }
}

fn line(what: &str, share: Option<f64>, taken: Duration) -> String {
    let seconds = taken.as_secs();
    match share {
        Some(share) => format!("{what} {:.0} %, {seconds} s", 100.0 * share.clamp(0.0, 1.0)),
        None => format!("{what}, {seconds} s"),
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        let state = self.state.0.lock();
        state.unwrap_or_else(PoisonError::into_inner).over = true;
        self.state.1.notify_all();
        if let Some(shows) = self.shows.take() {
            // It cannot have failed but by the terminal.
            let _ = shows.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_without_a_share_shows_that_it_lives() {
        let taken = Duration::from_millis(31_900);
        assert_eq!(line("reading r.csv", None, taken), "reading r.csv, 31 s");
        assert_eq!(
            line("explaining r.csv", Some(0.404), taken),
            "explaining r.csv 40 %, 31 s"
        );
    }
}
