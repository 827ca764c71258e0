//! Finished tasks on their way to being durable and marked. Syncing costs milliseconds a task, so tasks that follow each other
//! quickly share it.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::Result;
use crate::grid::Region;

/// How long a finished task waits for others, and at most a brick longer: what a kill can lose beside the tasks that are open.
/// 2-core Zen 4 VM, 2026-11-27: a sync takes 2 to 20 ms.
const PATIENCE: Duration = Duration::from_millis(200);

/// Finished tasks of one stream: number and region.
pub struct Commits {
    waiting: Mutex<(Vec<(usize, Region)>, Instant)>,
}

impl Default for Commits {
    fn default() -> Commits {
        Commits { waiting: Mutex::new((Vec::new(), Instant::now())) }
    }
}

impl Commits {
    /// Adds a task.
    pub fn add(&self, task: usize, region: Region) {
        self.waiting.lock().unwrap_or_else(|e| e.into_inner()).0.push((task, region));
    }

    /// Commits all that wait, where the last commit is long past. Asked after every brick.
    pub fn settle_due(&self, commit: impl FnOnce(&[(usize, Region)]) -> Result<()>) -> Result<()> {
        let due = {
            let waiting = self.waiting.lock().unwrap_or_else(|e| e.into_inner());
            !waiting.0.is_empty() && waiting.1.elapsed() >= PATIENCE
        };
        if due { self.settle(commit) } else { Ok(()) }
    }

    /// Commits all that wait.
    pub fn settle(&self, commit: impl FnOnce(&[(usize, Region)]) -> Result<()>) -> Result<()> {
        let tasks = {
            let mut waiting = self.waiting.lock().unwrap_or_else(|e| e.into_inner());
            waiting.1 = Instant::now();
            std::mem::take(&mut waiting.0)
        };
        if tasks.is_empty() { Ok(()) } else { commit(&tasks) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_that_waits_goes_with_a_later_brick() {
        let commits = Commits::default();
        let none = |_: &[(usize, Region)]| panic!("too early or nothing to commit");
        commits.settle_due(none).unwrap();
        commits.add(3, Region::whole([1; 3]));
        commits.waiting.lock().unwrap().1 = Instant::now();
        commits.settle_due(none).unwrap();
        commits.waiting.lock().unwrap().1 = Instant::now().checked_sub(PATIENCE).unwrap();
        let mut went = Vec::new();
        commits
            .settle_due(|tasks| {
                went.extend(tasks.iter().map(|t| t.0));
                Ok(())
            })
            .unwrap();
        assert_eq!(went, [3]);
        commits.settle(none).unwrap();
    }
}
