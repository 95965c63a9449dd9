//! Sealing of the truth: its hash is on the disk before the tool starts, and is compared when the scorer opens it.

use std::{
    fs::{self, File, OpenOptions},
    io::Write,
    path::{Path, PathBuf},
    sync::Mutex,
};

use anyhow::{Context, Result, bail};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

/// SHA-256 in hexadecimal.
pub fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

/// Of a file.
pub fn hash_file(path: &Path) -> Result<String> {
    Ok(hash(
        &fs::read(path).with_context(|| format!("reading {}", path.display()))?,
    ))
}

/// Keeps truths away from the tool, and a log of what was sealed, started and opened, in that order.
pub struct Safe {
    folder: PathBuf,
    log: Mutex<File>,
}

impl Safe {
    /// The log is `seals.jsonl`; it grows over the runs of a campaign.
    pub fn open(out: &Path) -> Result<Self> {
        let folder = out.join("sealed");
        fs::create_dir_all(&folder).with_context(|| format!("making {}", folder.display()))?;
        let path = out.join("seals.jsonl");
        let log = OpenOptions::new()
            .create(true)
            .append(true)
            .open(&path)
            .with_context(|| format!("opening {}", path.display()))?;
        Ok(Self {
            folder,
            log: Mutex::new(log),
        })
    }

    fn path(&self, id: &str) -> PathBuf {
        self.folder.join(format!("{id}.json"))
    }

    /// One line, on the disk before this returns.
    fn note(&self, line: &Value) -> Result<()> {
        let mut log = match self.log.lock() {
            Ok(log) => log,
            Err(poisoned) => poisoned.into_inner(),
        };
        writeln!(log, "{line}")?;
        log.sync_data().context("writing seals.jsonl")
    }

    /// Takes `truth.json` out of a maker's folder.
    pub fn take(&self, id: &str, made: &Path) -> Result<()> {
        let truth = made.join("truth.json");
        fs::rename(&truth, self.path(id)).with_context(|| format!("sealing {}", truth.display()))
    }

    /// Puts a truth that this program wrote itself.
    pub fn put(&self, id: &str, truth: &Value) -> Result<()> {
        fs::write(self.path(id), truth.to_string()).context("sealing")
    }

    /// Notes the truth's hash beside those of what the tool will get. To be called before the tool is started.
    pub fn seal(&self, id: &str, inputs: &[PathBuf]) -> Result<String> {
        let sealed = hash_file(&self.path(id))?;
        let mut given = serde_json::Map::new();
        for input in inputs {
            let name = input
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            given.insert(name, hash_file(input)?.into());
        }
        self.note(&json!({ "sealed": id, "truth_sha256": sealed, "given": given }))?;
        Ok(sealed)
    }

    /// Notes that the tool is about to start.
    pub fn started(&self, id: &str) -> Result<()> {
        self.note(&json!({ "started": id }))
    }

    /// Opens a seal; an error if the truth is no longer what was sealed.
    pub fn unseal(&self, id: &str, sealed: &str) -> Result<String> {
        let bytes = fs::read(self.path(id)).with_context(|| format!("the truth of {id}"))?;
        let found = hash(&bytes);
        self.note(&json!({ "opened": id, "truth_sha256": found }))?;
        if found != sealed {
            bail!("{id}: the truth was changed after it was sealed");
        }
        String::from_utf8(bytes).with_context(|| format!("the truth of {id}"))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    /// FIPS 180-4's example.
    #[test]
    fn the_hash_is_sha_256() {
        assert_eq!(
            hash(b"abc"),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
    }

    #[test]
    fn a_changed_truth_does_not_open() {
        let folder = tempfile::tempdir().unwrap();
        let safe = Safe::open(folder.path()).unwrap();
        safe.put("one", &json!({"kind": "d"})).unwrap();
        let sealed = safe.seal("one", &[]).unwrap();
        assert!(safe.unseal("one", &sealed).is_ok());
        safe.put("one", &json!({"kind": "a"})).unwrap();
        assert!(safe.unseal("one", &sealed).is_err());
        let log = fs::read_to_string(folder.path().join("seals.jsonl")).unwrap();
        assert_eq!(log.lines().count(), 3);
        assert!(log.starts_with("{\"given\"") || log.contains("\"sealed\":\"one\""));
    }
}
