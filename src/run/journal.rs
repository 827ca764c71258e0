//! What is done, for `--resume`: a header that says which run this is, and one line per finished task, each durable
//! before the next. A torn last line counts for nothing.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use serde_json::{Value, json};

use crate::store::os;
use crate::{Error, Result};

const HEADER: &str = "run.json";
const TASKS: &str = "tasks.log";

/// The journal of one run, in the work folder of its last output.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    file: Mutex<File>,
}

/// What an earlier run left.
#[derive(Debug, Clone, PartialEq)]
pub struct Earlier {
    pub header: Value,
    /// Task numbers that are done.
    pub done: Vec<usize>,
}

impl Journal {
    /// Reads what an earlier run left in `dir`; `None` where there is nothing usable.
    pub fn read(dir: &Path) -> Option<Earlier> {
        let header = serde_json::from_slice(&std::fs::read(dir.join(HEADER)).ok()?).ok()?;
        // Lines that a disk has broken count for nothing; the others still do.
        let text = String::from_utf8_lossy(&std::fs::read(dir.join(TASKS)).ok()?).into_owned();
        let whole = &text[..text.rfind('\n').map_or(0, |i| i + 1)];
        let number = |line: &str| line.strip_prefix("done ").and_then(|n| n.strip_suffix(" ok")?.parse().ok());
        Some(Earlier { header, done: whole.lines().filter_map(number).collect() })
    }

    /// Starts a journal, or continues one (`keep`).
    pub fn open(dir: &Path, header: &Value, keep: bool) -> Result<Journal> {
        let path = dir.join(TASKS);
        let fail = |e: std::io::Error| Error::file(&path, format!("cannot write the journal: {e}"));
        std::fs::create_dir_all(dir).map_err(fail)?;
        let mut file = OpenOptions::new().create(true).append(true).open(&path).map_err(fail)?;
        if keep {
            // Ends a torn line, so that the next one stands alone.
            file.write_all(b"\n").map_err(fail)?;
        } else {
            file.set_len(0).map_err(fail)?;
        }
        file.sync_all().map_err(fail)?;
        let journal = Journal { path, file: Mutex::new(file) };
        journal.write_header(dir, header)?;
        Ok(journal)
    }

    /// Replaces the header (pre-pass results are added to it once known).
    pub fn write_header(&self, dir: &Path, header: &Value) -> Result<()> {
        let (temp, path) = (dir.join("run.json.new"), dir.join(HEADER));
        let fail = |e: std::io::Error| Error::file(&path, format!("cannot write the journal: {e}"));
        let mut file = File::create(&temp).map_err(fail)?;
        file.write_all(header.to_string().as_bytes()).map_err(fail)?;
        file.sync_all().map_err(fail)?;
        std::fs::rename(&temp, &path).map_err(fail)?;
        os::sync_dir(dir).map_err(fail)
    }

    /// Marks tasks as done; everything that they wrote must be durable already.
    pub fn done(&self, tasks: &[usize]) -> Result<()> {
        let mut file = self.file.lock().unwrap_or_else(|e| e.into_inner());
        let lines: String = tasks.iter().map(|task| format!("done {task} ok\n")).collect();
        file.write_all(lines.as_bytes())
            .and_then(|()| file.sync_data())
            .map_err(|e| Error::file(&self.path, format!("cannot mark the tasks {tasks:?} as done: {e}")))
    }
}

/// Removes a journal's files.
pub fn remove(dir: &Path) {
    for name in [HEADER, TASKS, "run.json.new"] {
        let _ = std::fs::remove_file(dir.join(name));
    }
}

/// The header: everything that must be the same for a run to continue.
pub fn header(config_hash: &str, inputs: &[Value], tasks: usize, placement: &Value, globals: &[Vec<f64>]) -> Value {
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "config_hash": config_hash,
        "inputs": inputs,
        "tasks": tasks,
        "placement": placement,
        // As bits: text may lose NaN and the last digit.
        "globals": globals.iter().map(|g| g.iter().map(|v| v.to_bits()).collect()).collect::<Vec<Vec<u64>>>(),
    })
}

/// Pre-pass results kept in a header.
pub fn globals(header: &Value) -> Vec<Vec<f64>> {
    let list = header["globals"].as_array().cloned().unwrap_or_default();
    let numbers = |g: &Value| g.as_array()?.iter().map(|v| v.as_u64().map(f64::from_bits)).collect();
    list.iter().filter_map(numbers).collect()
}

/// The part of a header that differs and forbids to continue, in words.
pub fn difference(old: &Value, new: &Value) -> Option<&'static str> {
    let pairs = [
        ("version", "the program's version"),
        ("config_hash", "the configuration"),
        ("inputs", "an input file"),
        ("tasks", "the number of tasks"),
        ("placement", "the placement of stages"),
    ];
    pairs.into_iter().find(|(key, _)| old[key] != new[key]).map(|(_, words)| words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_torn_line_counts_for_nothing_and_the_next_run_goes_on() {
        let dir = tempfile::tempdir().unwrap();
        let head = header("h", &[], 3, &json!({}), &[vec![f64::NAN, 0.1]]);
        let journal = Journal::open(dir.path(), &head, false).unwrap();
        journal.done(&[2]).unwrap();
        drop(journal);
        let log = dir.path().join(TASKS);
        OpenOptions::new().append(true).open(&log).unwrap().write_all(b"done 1").unwrap(); // of `done 12 ok`
        assert_eq!(Journal::read(dir.path()).unwrap().done, [2]);
        OpenOptions::new().append(true).open(&log).unwrap().write_all(b"\xff\xfe").unwrap();
        Journal::open(dir.path(), &head, true).unwrap().done(&[0]).unwrap();
        let earlier = Journal::read(dir.path()).unwrap();
        assert_eq!(earlier.done, [2, 0]);
        assert_eq!(globals(&earlier.header)[0][1], 0.1);
        assert!(difference(&head, &header("other", &[], 3, &json!({}), &[])).is_some());
    }
}
