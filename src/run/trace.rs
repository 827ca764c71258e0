//! `--trace`: one span per brick and stage in the Chrome format, which Perfetto opens.

use std::path::Path;
use std::sync::Mutex;
use std::thread::ThreadId;
use std::time::Instant;

use crate::{Error, Result};

/// Collects spans, as text, which takes a tenth of parsed values; does nothing unless switched on.
#[derive(Debug)]
pub struct Trace {
    start: Instant,
    spans: Option<Mutex<Spans>>,
}

#[derive(Debug, Default)]
struct Spans {
    text: String,
    /// Threads by number.
    threads: Vec<ThreadId>,
}

impl Trace {
    pub fn new(on: bool) -> Trace {
        Trace { start: Instant::now(), spans: on.then(Mutex::default) }
    }

    /// A span from `start` until now on the calling thread.
    pub fn span(&self, name: &str, start: Instant, args: &[(&str, String)]) {
        let Some(spans) = &self.spans else { return };
        let args: serde_json::Map<String, serde_json::Value> =
            args.iter().map(|(k, v)| (k.to_string(), v.clone().into())).collect();
        let (at, took) = (start.duration_since(self.start).as_secs_f64(), start.elapsed().as_secs_f64());
        let mut spans = spans.lock().unwrap_or_else(|e| e.into_inner());
        let event = serde_json::json!({
            "name": name, "ph": "X", "pid": 1, "tid": spans.number(std::thread::current().id()),
            "ts": at * 1e6, "dur": took * 1e6, "args": args,
        });
        if !spans.text.is_empty() {
            spans.text.push_str(",\n");
        }
        spans.text.push_str(&event.to_string());
    }

    pub fn write(&self, path: &Path) -> Result<()> {
        let Some(spans) = &self.spans else { return Ok(()) };
        let spans = spans.lock().unwrap_or_else(|e| e.into_inner());
        let text = ["{\"displayTimeUnit\":\"ms\",\"traceEvents\":[\n", &spans.text, "\n]}\n"].concat();
        std::fs::write(path, text).map_err(|e| Error::file(path, format!("cannot write the trace: {e}")))
    }
}

impl Spans {
    /// A small number for a thread: 1 for the first that is seen.
    fn number(&mut self, thread: ThreadId) -> usize {
        let known = self.threads.iter().position(|t| *t == thread);
        1 + known.unwrap_or_else(|| {
            self.threads.push(thread);
            self.threads.len() - 1
        })
    }
}
