//! Graph to plan.

use crate::Result;
use crate::config::Config;

/// The plan as text and as JSON; runs nothing.
pub fn explain(config: &Config) -> Result<(String, serde_json::Value)> {
    let _ = config;
    todo!()
}
