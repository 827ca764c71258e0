//! `--trace`: one span per brick and stage in the Chrome format, which Perfetto opens.

use std::path::Path;
use std::sync::Mutex;
use std::time::Instant;

use crate::{Error, Result};

/// Collects spans, as text, which takes a tenth of parsed values; does nothing unless switched on.
#[derive(Debug)]
pub struct Trace {
    start: Instant,
    events: Option<Mutex<String>>,
}

impl Trace {
    pub fn new(on: bool) -> Trace {
        Trace { start: Instant::now(), events: on.then(Mutex::default) }
    }

    /// A span from `start` until now on the calling thread.
    pub fn span(&self, name: &str, start: Instant, args: &[(&str, String)]) {
        let Some(events) = &self.events else { return };
        let args: serde_json::Map<String, serde_json::Value> =
            args.iter().map(|(k, v)| (k.to_string(), v.clone().into())).collect();
        let event = serde_json::json!({
            "name": name, "ph": "X", "pid": 1, "tid": thread_number(),
            "ts": start.duration_since(self.start).as_secs_f64() * 1e6,
            "dur": start.elapsed().as_secs_f64() * 1e6,
            "args": args,
        });
        let mut events = events.lock().unwrap_or_else(|e| e.into_inner());
        if !events.is_empty() {
            events.push_str(",\n");
        }
        events.push_str(&event.to_string());
    }

    pub fn write(&self, path: &Path) -> Result<()> {
        let Some(events) = &self.events else { return Ok(()) };
        let events = events.lock().unwrap_or_else(|e| e.into_inner());
        let text = ["{\"displayTimeUnit\":\"ms\",\"traceEvents\":[\n", &events, "\n]}\n"].concat();
        std::fs::write(path, text).map_err(|e| Error::file(path, format!("cannot write the trace: {e}")))
    }
}

/// A small number for the calling thread: rayon workers by index, others after them.
fn thread_number() -> usize {
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
    static NEXT: AtomicUsize = AtomicUsize::new(1);
    thread_local!(static NUMBER: usize = NEXT.fetch_add(1, Relaxed));
    NUMBER.with(|n| *n)
}
