//! Runs a plan: makes, seals, explains, holds out, compares, opens; one small file a case, so that a broken run goes on
//! where it was.

use std::{
    collections::{BTreeMap, VecDeque},
    fs,
    path::{Path, PathBuf},
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{
    board::{Board, Calibrated},
    case::{Group, Planned, Truth},
    make::{Folders, Makers, hash_of_sources},
    methods::{Found, Methods},
    program::locked,
    real::Expected,
    score::{self, Judgement},
    seal::{Safe, hash, hash_file},
    table::Table,
    tool::{Given, Said, Tool},
};

/// Processor time for one explanation of a made case.
const LIMIT: Duration = Duration::from_secs(60);
/// Of a real recording, which may have 48,000 rows.
const LIMIT_REAL: Duration = Duration::from_secs(200);
/// Cases that are made at one go: they share what is the same in all of them.
const BATCH: usize = 10;

/// Everything about one case; one file of `results/`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Record {
    /// Over case, tool and sources: with another key it is run again.
    pub key: String,
    /// What was to be done.
    pub planned: Planned,
    /// Opened after the tool had ended.
    pub truth: Option<Truth>,
    /// As sealed before it started.
    pub truth_sha256: String,
    /// Why there is no data (the maker's own limits).
    pub not_made: Option<String>,
    /// What the tool said; nothing if it failed.
    pub said: Option<Said>,
    /// Why it failed.
    pub error: Option<String>,
    /// With the true effects taken out of the library.
    pub without: Option<Said>,
    /// Those effects.
    pub removed: Vec<String>,
    /// The second run of the same gave the same report.
    pub same: Option<bool>,
    /// Of the reported place with the true one.
    pub overlap: Option<f64>,
    /// Today's methods.
    pub methods: BTreeMap<String, Found>,
    /// Over their sources and the data: with another key they are run again.
    #[serde(default)]
    pub methods_key: String,
    /// Of the emulated board.
    pub calibrated: Option<Calibrated>,
    /// Seconds of the wall clock that each part took; a batch's making is shared out.
    pub parts_s: BTreeMap<String, f64>,
}

impl Record {
    /// Does a part, and notes what it took.
    fn timed<T>(&mut self, part: &str, work: impl FnOnce(&mut Self) -> T) -> T {
        let start = Instant::now();
        let result = work(self);
        *self.parts_s.entry(part.to_owned()).or_insert(0.0) += start.elapsed().as_secs_f64();
        result
    }

    /// How the case went.
    pub fn judgement(&self) -> Option<Judgement> {
        let truth = self.truth.as_ref()?;
        Some(score::judge(
            truth,
            truth.strength(self.planned.case.strength()),
            &[],
            // One that was explained and not simulated afterwards has failed, too.
            self.said.as_ref().filter(|_| self.error.is_none()),
        ))
    }

    /// Something was taken out of the library, and what the tool says then is not there.
    pub fn failed_without(&self) -> bool {
        !self.removed.is_empty() && self.without.is_none()
    }

    /// How it went without the true effects in the library.
    pub fn judgement_without(&self) -> Option<Judgement> {
        let truth = self.truth.as_ref()?;
        if self.removed.is_empty() {
            return None;
        }
        let mut left = truth.clone();
        // What can stand for it by construction may still be named.
        for list in &mut left.required {
            list.retain(|id| !self.removed.contains(id));
        }
        Some(score::judge(
            &left,
            truth.strength(self.planned.case.strength()),
            &self.removed,
            self.without.as_ref(),
        ))
    }
}

/// What a campaign works with.
pub struct Campaign {
    /// The checkout's top folder.
    pub root: PathBuf,
    /// Where everything goes.
    pub out: PathBuf,
    /// twin.
    pub tool: Tool,
    /// Python makers.
    pub makers: Makers,
    /// Today's methods.
    pub methods: Methods,
    /// The emulated board, if there is one.
    pub board: Option<Board>,
    /// Of expected.toml.
    pub real: Vec<Expected>,
    /// Cases that run at once.
    pub workers: usize,
    /// Keep the data of every case.
    pub keep: bool,
    /// No case is begun after this time; the next run goes on.
    pub limit: Option<Duration>,
}

/// Hashes of what decides results.
#[derive(PartialEq)]
struct Sources {
    tool: String,
    makers: BTreeMap<String, String>,
    methods: String,
    expected: String,
    board: String,
    /// Models, recordings and packages, and what of this program works on a case.
    inputs: String,
}

/// What is worked out while a case runs, and kept; how an answer is judged is worked out anew each time.
const OWN: [&str; 10] = [
    include_str!("run.rs"),
    include_str!("tool.rs"),
    include_str!("make.rs"),
    include_str!("program.rs"),
    include_str!("serve.py"),
    include_str!("real.rs"),
    include_str!("board.rs"),
    include_str!("table.rs"),
    include_str!("methods.rs"),
    // The overlap of places is kept.
    include_str!("score.rs"),
];

/// Over all files of a folder and of those in it; of none where it is not there.
fn hash_tree(folder: &Path, all: &mut String) -> Result<()> {
    if !folder.is_dir() {
        return Ok(());
    }
    let entries = fs::read_dir(folder).with_context(|| format!("reading {}", folder.display()))?;
    let mut paths = entries
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<std::io::Result<Vec<PathBuf>>>()
        .with_context(|| format!("reading {}", folder.display()))?;
    paths.sort();
    for path in paths {
        if path.is_dir() {
            hash_tree(&path, all)?;
        } else {
            all.push_str(&hash_file(&path)?);
        }
    }
    Ok(())
}

impl Sources {
    /// Of a case: over it and what is used for it.
    fn key(&self, planned: &Planned) -> Result<String> {
        let mut all = serde_json::to_string(planned)?;
        all.push_str(&self.tool);
        all.push_str(&self.inputs);
        all.push_str(match planned.group {
            Group::Real => &self.expected,
            Group::Board => &self.board,
            _ => self
                .makers
                .get(&planned.case.maker)
                .context("a case without a maker")?,
        });
        if !planned.methods.is_empty() {
            all.push_str(&self.methods);
        }
        Ok(hash(all.as_bytes()))
    }
}

struct Progress {
    done: AtomicUsize,
    of: usize,
    start: Instant,
}

impl Progress {
    fn tell(&self, record: &Record) {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        let outcome = record.judgement().map_or_else(
            || "not made".to_owned(),
            |judged| {
                serde_json::to_value(judged.outcome)
                    .ok()
                    .and_then(|value| value.as_str().map(str::to_owned))
                    .unwrap_or_default()
            },
        );
        let seconds = record.said.as_ref().map_or(0.0, |said| said.taken.seconds);
        let left = self.start.elapsed().as_secs_f64() / done as f64 * (self.of - done) as f64;
        eprintln!(
            "[{done:>4}/{}] {:<9} {seconds:5.1} s  {}  ({:.0} min left)",
            self.of,
            outcome,
            record.planned.case.id,
            left / 60.0
        );
    }
}

impl Campaign {
    /// Runs what is not there yet; the record of every case that was run, in the order of the plan.
    pub fn run(&self, plan: &[Planned]) -> Result<Vec<Record>> {
        let results = self.out.join("results");
        fs::create_dir_all(&results).with_context(|| format!("making {}", results.display()))?;
        let safe = Safe::open(&self.out)?;
        let sources = self.sources(plan)?;
        let mut records: BTreeMap<String, Record> = BTreeMap::new();
        let mut open: Vec<(Planned, String)> = Vec::new();
        for planned in plan {
            let key = sources.key(planned)?;
            match read_record(&results, &planned.case.id) {
                Some(record) if record.key == key => {
                    records.insert(planned.case.id.clone(), record);
                }
                _ => open.push((planned.clone(), key)),
            }
        }
        if !records.is_empty() {
            eprintln!(
                "{} of {} cases are there from an earlier run",
                records.len(),
                plan.len()
            );
        }
        let progress = Progress {
            done: AtomicUsize::new(0),
            of: open.len(),
            start: Instant::now(),
        };
        let queue = Mutex::new(mixed(batches(open)));
        let ran: Mutex<Vec<Record>> = Mutex::new(Vec::new());
        let failed: Mutex<Option<anyhow::Error>> = Mutex::new(None);
        thread::scope(|scope| {
            for _ in 0..self.workers {
                scope.spawn(|| {
                    loop {
                        let late = self
                            .limit
                            .is_some_and(|limit| progress.start.elapsed() > limit);
                        if late || locked(&failed).is_some() {
                            return;
                        }
                        let Some(batch) = locked(&queue).pop_front() else {
                            return;
                        };
                        if let Err(error) = self.batch(&batch, &safe, &results, &progress, &ran) {
                            *locked(&failed) = Some(error);
                        }
                    }
                });
            }
        });
        if let Some(error) = locked(&failed).take() {
            return Err(error);
        }
        for record in locked(&ran).drain(..) {
            records.insert(record.planned.case.id.clone(), record);
        }
        if self.sources(plan)? != sources {
            bail!(
                "the tool, the makers, the methods or expected.toml changed while the campaign ran: run it again"
            );
        }
        Ok(plan
            .iter()
            .filter_map(|planned| records.remove(&planned.case.id))
            .collect())
    }

    /// What decides a result beside the case itself.
    fn sources(&self, plan: &[Planned]) -> Result<Sources> {
        let mut makers = BTreeMap::new();
        for planned in plan {
            let maker = &planned.case.maker;
            if !makers.contains_key(maker) {
                makers.insert(maker.clone(), self.makers.hash(maker)?);
            }
        }
        Ok(Sources {
            tool: hash_file(&self.tool.program)?,
            makers,
            methods: if self.methods.there() {
                hash_of_sources(&self.methods.folder)?
            } else {
                String::new()
            },
            expected: hash_file(&self.root.join("proof/expected.toml"))?,
            board: match &self.board {
                Some(board) => hash_file(&board.emulate)? + &hash_file(&board.image)?,
                None => String::new(),
            },
            inputs: self.inputs()?,
        })
    }

    fn inputs(&self) -> Result<String> {
        let mut all = OWN.concat();
        for folder in ["models", "recordings"] {
            hash_tree(&self.root.join(folder), &mut all)?;
        }
        let packages = self.root.join("proof/requirements.txt");
        if packages.exists() {
            all.push_str(&hash_file(&packages)?);
        }
        Ok(hash(all.as_bytes()))
    }

    fn batch(
        &self,
        batch: &[(Planned, String)],
        safe: &Safe,
        results: &Path,
        progress: &Progress,
        ran: &Mutex<Vec<Record>>,
    ) -> Result<()> {
        let planned: Vec<Planned> = batch.iter().map(|(planned, _)| planned.clone()).collect();
        let start = Instant::now();
        let made = match planned[0].group {
            Group::Real => vec![self.prepare_real(&planned[0], safe)],
            Group::Board => vec![self.prepare_board(&planned[0], safe)],
            _ => self.makers.make(&planned, &self.out, safe)?,
        };
        let made_s = start.elapsed().as_secs_f64() / batch.len() as f64;
        for ((planned, key), not_made) in batch.iter().zip(made) {
            let earlier = read_record(results, &planned.case.id);
            let record = self.case(planned, key, (not_made, made_s), earlier, safe)?;
            let path = results.join(format!("{}.json", planned.case.id));
            let part = path.with_extension("part");
            fs::write(&part, serde_json::to_string(&record)?)?;
            fs::rename(&part, &path)?;
            progress.tell(&record);
            let right = record.judgement().is_none_or(|judged| {
                judged.outcome.right() || judged.outcome == score::Outcome::Quiet
            });
            if right && !self.keep {
                let folder = Folders::new(&self.out, &planned.case.id).case;
                fs::remove_dir_all(&folder)
                    .with_context(|| format!("removing {}", folder.display()))?;
            }
            locked(ran).push(record);
        }
        Ok(())
    }

    fn prepare_real(&self, planned: &Planned, safe: &Safe) -> Option<String> {
        let prepare = || -> Result<()> {
            let Some(one) = self.real.iter().find(|one| one.id == planned.case.drive) else {
                bail!("expected.toml has no {}", planned.case.drive);
            };
            let folders = Folders::new(&self.out, &planned.case.id);
            folders.clear()?;
            one.prepare(&self.root, &folders.given, &folders.kept)?;
            safe.put(&planned.case.id, &serde_json::to_value(one.truth())?)
        };
        prepare().err().map(|error| format!("{error:#}"))
    }

    fn prepare_board(&self, planned: &Planned, safe: &Safe) -> Option<String> {
        let prepare = || -> Result<()> {
            let Some(board) = &self.board else {
                bail!("no emulator was given");
            };
            let folders = Folders::new(&self.out, &planned.case.id);
            folders.clear()?;
            let truth = board.prepare(&self.root, planned, &folders)?;
            safe.put(&planned.case.id, &serde_json::to_value(truth)?)
        };
        prepare().err().map(|error| format!("{error:#}"))
    }

    /// Seals, explains, holds out, compares, opens.
    fn case(
        &self,
        planned: &Planned,
        key: &str,
        (not_made, made_s): (Option<String>, f64),
        earlier: Option<Record>,
        safe: &Safe,
    ) -> Result<Record> {
        let id = &planned.case.id;
        let mut record = Record {
            key: key.to_owned(),
            planned: planned.clone(),
            truth: None,
            truth_sha256: String::new(),
            not_made,
            said: None,
            error: None,
            without: None,
            removed: Vec::new(),
            same: None,
            overlap: None,
            methods: BTreeMap::new(),
            methods_key: String::new(),
            calibrated: None,
            parts_s: BTreeMap::from([("make".to_owned(), made_s)]),
        };
        if record.not_made.is_some() {
            return Ok(record);
        }
        let folders = Folders::new(&self.out, id);
        folders.data_only()?;
        record.truth_sha256 = safe.seal(id, &folders.inputs()?)?;
        safe.started(id)?;
        let limit = if planned.group == Group::Real {
            LIMIT_REAL
        } else {
            LIMIT
        };
        let given = Given {
            two_clocks: folders.given.join("reference.csv").exists(),
            without: Vec::new(),
        };
        let explained = record.timed("explain", |_| {
            self.tool.explain(&folders.given, "out", &given, limit)
        });
        match explained {
            Ok(said) => record.said = Some(said),
            Err(error) => record.error = Some(format!("{error:#}")),
        }
        if planned.twice && record.said.is_some() {
            let again = record.timed("again", |_| {
                self.tool.explain(&folders.given, "again", &given, limit)
            });
            record.same = Some(again.is_ok() && same_report(&folders.given)?);
        }
        if record.said.is_some() {
            let found = folders.given.join("out/model.toml");
            let designed = folders.given.join("model.toml");
            let held_out = record.timed("hold out", |_| {
                self.tool.held_out(
                    &folders.kept,
                    &absolute(&designed)?,
                    &absolute(&found)?,
                    given.two_clocks,
                    limit,
                )
            });
            match (held_out, &mut record.said) {
                (Ok(errors), Some(said)) => said.held_out = errors,
                (Err(error), _) => record.error = Some(format!("held out: {error:#}")),
                (Ok(_), None) => {}
            }
        }
        self.compare(&mut record, earlier, &folders)?;

        let opened = safe.unseal(id, &record.truth_sha256)?;
        let truth: Truth = match serde_json::from_str(&opened) {
            Ok(truth) => truth,
            Err(error) => {
                record.not_made = Some(format!("truth.json: {error}"));
                return Ok(record);
            }
        };
        if planned.without {
            record.removed = truth
                .effects
                .iter()
                .map(|effect| effect.id.clone())
                .collect();
            let given = Given {
                without: record.removed.clone(),
                ..given
            };
            record.without = record
                .timed("without", |_| {
                    self.tool.explain(&folders.given, "without", &given, limit)
                })
                .ok();
        }
        if let (Some(place), Some(said)) = (&truth.place, &record.said) {
            let recording = Table::read(&folders.given.join("recording.csv"))?;
            record.overlap = score::overlap(place, &said.locations, &recording);
        }
        let before = record
            .said
            .as_ref()
            .and_then(|said| Some(said.held_out.get("i_meas_a")?.before));
        if planned.group == Group::Board
            && let (Some(board), Some(before_a)) = (&self.board, before)
        {
            let calibrated = record.timed("drive again", |_| {
                board.calibrated(&self.root, &self.tool, planned, &folders, before_a)
            });
            match calibrated {
                Ok(calibrated) => record.calibrated = calibrated,
                Err(error) => record.error = Some(format!("calibrated: {error:#}")),
            }
        }
        record.truth = Some(truth);
        Ok(record)
    }
}

impl Campaign {
    /// Today's methods on the same data; they know nothing of the tool, so that what an earlier run found still holds for the
    /// same data.
    fn compare(
        &self,
        record: &mut Record,
        earlier: Option<Record>,
        folders: &Folders,
    ) -> Result<()> {
        let wanted = record.planned.methods.clone();
        if wanted.is_empty() || !self.methods.there() {
            return Ok(());
        }
        let sources = hash_of_sources(&self.methods.folder)?;
        record.methods_key = hash((sources + &folders.hash()?).as_bytes());
        let mut known = BTreeMap::new();
        if let Some(earlier) = earlier.filter(|earlier| earlier.methods_key == record.methods_key) {
            known = earlier.methods;
            if let Some(took_s) = earlier.parts_s.get("methods") {
                record.parts_s.insert("methods".to_owned(), *took_s);
            }
        }
        for method in wanted {
            let found = match known.remove(&method) {
                Some(found) => found,
                None => record.timed("methods", |_| self.methods.run(&method, folders)),
            };
            record.methods.insert(method, found);
        }
        Ok(())
    }
}

fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).with_context(|| path.display().to_string())
}

/// The two reports of the same run, time apart.
fn same_report(given: &Path) -> Result<bool> {
    let read = |out: &str| -> Result<Value> {
        let path = given.join(out).join("report.json");
        let mut report: Value = serde_json::from_str(&fs::read_to_string(&path)?)?;
        if let Some(object) = report.as_object_mut() {
            object.remove("seconds");
        }
        Ok(report)
    };
    Ok(read("out")? == read("again")?)
}

fn read_record(results: &Path, id: &str) -> Option<Record> {
    let text = fs::read_to_string(results.join(format!("{id}.json"))).ok()?;
    serde_json::from_str(&text).ok()
}

/// Cases of one maker together; real recordings and the board one by one.
fn batches(open: Vec<(Planned, String)>) -> VecDeque<Vec<(Planned, String)>> {
    let mut batches: VecDeque<Vec<(Planned, String)>> = VecDeque::new();
    for one in open {
        let maker = one.0.case.maker.clone();
        match batches.back_mut() {
            Some(last)
                if !maker.is_empty() && last[0].0.case.maker == maker && last.len() < BATCH =>
            {
                last.push(one);
            }
            _ => batches.push_back(vec![one]),
        }
    }
    batches
}

/// Real recordings and the board first; then the batches in an order without meaning, so that a run that ends early has some
/// of everything.
fn mixed(batches: VecDeque<Vec<(Planned, String)>>) -> VecDeque<Vec<(Planned, String)>> {
    let mut batches = Vec::from(batches);
    batches.sort_by_cached_key(|batch| {
        let first = &batch[0].0;
        let made = !first.case.maker.is_empty();
        (made, made.then(|| hash(first.case.id.as_bytes())))
    });
    batches.into()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::{case::Case, score::Outcome};

    /// A maker that knows one clean recording.
    const MAKER: &str = r#"
import json, pathlib, sys
def main(arguments):
    with open(pathlib.Path(__file__).parent / "runs", "a") as runs:
        print("run", file=runs)
    for case, out in json.loads(pathlib.Path(arguments[1]).read_text()):
        out = pathlib.Path(out)
        out.mkdir()
        for name in ("recording.csv", "holdout.csv"):
            (out / name).write_text("t_s,i_ref_a,i_meas_a\n0,1,1\n1,2,2\n")
        (out / "model.toml").write_text("schema = 1\n")
        (out / "truth.json").write_text('{"kind": "d", "maker": "test"}')
"#;

    /// A method that always names the same.
    const METHOD: &str = r#"
import json, pathlib, sys
def main(arguments):
    with open(pathlib.Path(__file__).parent / "runs", "a") as runs:
        print("run", file=runs)
    pathlib.Path(arguments[2]).write_text(json.dumps({"named": ["offset"]}))
"#;

    /// A tool that says "no mismatch", but fails if the seal is not on the disk or the truth is in reach.
    const TOOL: &str = r#"#!/bin/sh
for last; do :; done
if [ "$1" = explain ]; then
    grep -q '"sealed":"one"' ../../../seals.jsonl || exit 3
    test -z "$(find .. -name 'truth*')" || exit 4
    mkdir -p "$last"
    printf '{"verdict": "no-mismatch", "effects": [], "locations": []}' > "$last/report.json"
    cp model.toml "$last/model.toml"
    echo run >> ../../../runs
else
    cp holdout.csv "$last"
fi
"#;

    fn campaign(folder: &Path, tool: &str) -> Campaign {
        let write = |name: &str, text: &str| {
            let path = folder.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, text).unwrap();
            path
        };
        write("proof/expected.toml", "case = []\n");
        let maker = write("makers/make.py", MAKER);
        let program = write("twin", tool);
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        Campaign {
            root: folder.to_path_buf(),
            out: folder.join("out"),
            tool: Tool {
                program,
                threads: 1,
            },
            makers: Makers::new(Path::new("python3"), maker.parent().unwrap().to_path_buf()),
            methods: Methods::new(Path::new("python3"), folder.join("methods")),
            board: None,
            limit: None,
            real: Vec::new(),
            workers: 1,
            keep: true,
        }
    }

    fn plan() -> Vec<Planned> {
        vec![Planned {
            group: Group::Clean,
            case: Case {
                id: "one".to_owned(),
                maker: "sensing".to_owned(),
                effects: Vec::new(),
                noise: "white".to_owned(),
                drive: "us06".to_owned(),
                seed: 1,
                rows: 2,
                options: serde_json::Map::new(),
            },
            without: false,
            twice: true,
            methods: Vec::new(),
        }]
    }

    fn lines(path: &Path) -> usize {
        fs::read_to_string(path).unwrap().lines().count()
    }

    #[test]
    fn a_case_is_sealed_before_the_tool_starts_and_run_once_only() {
        let folder = tempfile::tempdir().unwrap();
        let runs = || lines(&folder.path().join("out/runs"));
        let records = campaign(folder.path(), TOOL).run(&plan()).unwrap();
        assert_eq!(records[0].error, None);
        assert_eq!(records[0].judgement().unwrap().outcome, Outcome::Quiet);
        assert_eq!(records[0].same, Some(true));
        let (_, held_out) = records[0].said.as_ref().unwrap().main_held_out().unwrap();
        assert_eq!((held_out.after, held_out.rows), (0.0, 2));
        // Explained twice, for the comparison of the two reports.
        assert_eq!(runs(), 2);
        let again = campaign(folder.path(), TOOL).run(&plan()).unwrap();
        assert_eq!((runs(), &again[0].key), (2, &records[0].key));
        let other = campaign(folder.path(), &format!("{TOOL}# changed\n"))
            .run(&plan())
            .unwrap();
        assert_eq!(runs(), 4);
        assert_ne!(other[0].key, records[0].key);
        // So does what a recording or a model holds.
        let models = folder.path().join("models");
        fs::create_dir_all(&models).unwrap();
        fs::write(models.join("car.toml"), "schema = 1\n").unwrap();
        let with_model = campaign(folder.path(), &format!("{TOOL}# changed\n"))
            .run(&plan())
            .unwrap();
        assert_eq!(runs(), 6);
        assert_ne!(with_model[0].key, other[0].key);
        // The data were there; another maker makes others.
        let made = || lines(&folder.path().join("makers/runs"));
        assert_eq!(made(), 1);
        let changed = campaign(folder.path(), TOOL);
        let maker = folder.path().join("makers/make.py");
        fs::write(maker, format!("{MAKER}# changed\n")).unwrap();
        changed.run(&plan()).unwrap();
        assert_eq!((runs(), made()), (8, 2));
    }

    #[test]
    fn methods_are_run_again_for_other_data_only() {
        let folder = tempfile::tempdir().unwrap();
        let mut plan = plan();
        plan[0].methods = vec!["bic".to_owned()];
        let with_methods = |tool: &str| {
            let campaign = campaign(folder.path(), tool);
            fs::create_dir_all(&campaign.methods.folder).unwrap();
            fs::write(campaign.methods.folder.join("run.py"), METHOD).unwrap();
            campaign
        };
        let runs = || lines(&folder.path().join("methods/runs"));
        let first = with_methods(TOOL).run(&plan).unwrap();
        assert_eq!(first[0].methods["bic"].named, ["offset"]);
        let second = with_methods(&format!("{TOOL}# changed\n"))
            .run(&plan)
            .unwrap();
        assert_eq!((runs(), &second[0].methods), (1, &first[0].methods));
        let changed = with_methods(TOOL);
        let other = MAKER.replace("0,1,1", "0,1,2");
        fs::write(folder.path().join("makers/make.py"), other).unwrap();
        changed.run(&plan).unwrap();
        assert_eq!(runs(), 2);
    }

    #[test]
    fn a_tool_that_fails_is_an_error_in_the_tables() {
        let folder = tempfile::tempdir().unwrap();
        let records = campaign(folder.path(), "#!/bin/sh\necho broken >&2\nexit 101\n")
            .run(&plan())
            .unwrap();
        assert!(records[0].error.as_ref().unwrap().contains("broken"));
        assert_eq!(records[0].judgement().unwrap().outcome, Outcome::Error);
    }

    #[test]
    fn what_cannot_be_made_is_told_and_not_scored() {
        let folder = tempfile::tempdir().unwrap();
        let campaign = campaign(folder.path(), TOOL);
        let maker = folder.path().join("makers/make.py");
        fs::write(
            maker,
            "def main(_):\n    raise SystemExit('no such strength')\n",
        )
        .unwrap();
        let records = campaign.run(&plan()).unwrap();
        let why = records[0].not_made.as_ref().unwrap();
        assert!(why.contains("no such strength"), "{why}");
        assert_eq!(records[0].judgement(), None);
    }
}
