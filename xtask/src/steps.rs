//! A command's steps: a heading each, the time taken, and what failed at the end.

use std::time::{Duration, Instant};

use anyhow::Result;

/// What has been done so far.
#[derive(Default)]
pub struct Steps {
    done: Vec<(String, Duration)>,
    failures: Vec<(String, anyhow::Error)>,
}

impl Steps {
    /// Does one step. A failure is noted and the next step goes on; what it returns is what later steps need.
    pub fn step<T>(&mut self, name: &str, work: impl FnOnce() -> Result<T>) -> Option<T> {
        println!("\n== {name}");
        let start = Instant::now();
        let result = work();
        let taken = start.elapsed();
        self.done.push((name.to_owned(), taken));
        match result {
            Ok(value) => {
                println!("   {name}: {:.1} s", taken.as_secs_f64());
                Some(value)
            }
            Err(error) => {
                println!(
                    "   {name}: FAILED after {:.1} s: {error:#}",
                    taken.as_secs_f64()
                );
                self.failures.push((name.to_owned(), error));
                None
            }
        }
    }

    /// Notes a step that cannot be done because an earlier one failed.
    pub fn skip(&mut self, name: &str, why: &str) {
        println!("\n== {name}\n   not done: {why}");
        self.failures
            .push((name.to_owned(), anyhow::anyhow!("not done: {why}")));
    }

    /// One line per step with its time.
    pub fn print_times(&self) {
        println!("\n== Time");
        for (name, taken) in &self.done {
            println!("{:8.1} s  {name}", taken.as_secs_f64());
        }
        let total: Duration = self.done.iter().map(|(_, taken)| *taken).sum();
        println!("{:8.1} s  in all", total.as_secs_f64());
    }

    /// Repeats every failure; `true` if there was one.
    pub fn print_failures(&self) -> bool {
        if !self.failures.is_empty() {
            println!("\n== Failed");
            for (name, error) in &self.failures {
                println!("{name}: {error:#}");
            }
        }
        !self.failures.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_is_kept_and_later_steps_still_run() {
        let mut steps = Steps::default();
        assert_eq!(steps.step("first", || anyhow::bail!("broken")), None::<()>);
        assert_eq!(steps.step("second", || Ok(7)), Some(7));
        assert!(steps.print_failures());
        assert_eq!(steps.done.len(), 2);
    }

    #[test]
    fn a_step_left_out_counts_as_failed() {
        let mut steps = Steps::default();
        assert!(!steps.print_failures());
        steps.skip("size", "no image");
        assert!(steps.print_failures());
    }
}
