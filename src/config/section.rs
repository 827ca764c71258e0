//! One table of the config, read key by key through the table of keys: types, defaults and refusals with their place.

use super::keys::{self, Default, Key, Section};
use super::kinds::Kind;
use super::read::{self, Bad};
use super::tree::{self, Node, Table, Value};
use super::{Place, suggest};
use crate::{Error, Result};

/// A table being read.
pub struct Reader<'a> {
    pub section: Section,
    /// Value of `op` for stages, else empty.
    pub op: &'a str,
    pub table: &'a Table,
    pub place: Place,
}

impl<'a> Reader<'a> {
    /// Refuses keys that the table of keys does not have.
    pub fn new(section: Section, key: String, op: &'a str, node: &'a Node) -> Result<Reader<'a>> {
        let Value::Table(table) = &node.value else {
            let what = if key.contains('.') { "a table of keys" } else { "a table" };
            return Err(error(&key, node.line, format!("got {node}; expected {what}")));
        };
        let lines = table.iter().filter_map(|(k, n)| n.line.map(|l| (k.clone(), l))).collect();
        let reader = Reader { section, op, table, place: Place { key, line: node.line, lines } };
        for (name, node) in table {
            reader.refuse_unknown(name, node)?;
        }
        Ok(reader)
    }

    fn refuse_unknown(&self, name: &str, node: &Node) -> Result<()> {
        let taken: Vec<&str> = keys::of(self.section, self.op).map(|k| k.name).collect();
        if taken.contains(&name) {
            return Ok(());
        }
        let owner = match self.section {
            Section::Stage => format!("op {:?}", self.op),
            _ => "this table".to_string(),
        };
        let ops: Vec<&str> = keys::owners(self.section, name).flat_map(|k| k.ops).copied().collect();
        let elsewhere = if ops.is_empty() { String::new() } else { format!(" (it belongs to {})", ops.join(", ")) };
        let hint = if ops.is_empty() { suggest::hint(name, taken.iter().copied()) } else { String::new() };
        let message = format!("{owner} has no key {name:?}{elsewhere}{hint}; accepted: {}", taken.join(", "));
        Err(error(&self.dotted(name), node.line.or(self.place.line), message))
    }

    fn dotted(&self, name: &str) -> String {
        format!("{}.{name}", self.place.key)
    }

    fn spec(&self, name: &str) -> &'static Key {
        let found = keys::of(self.section, self.op).find(|k| k.name == name);
        found.unwrap_or_else(|| panic!("the table of keys lacks {}", self.dotted(name)))
    }

    /// The value as given.
    pub fn node(&self, name: &str) -> Option<&'a Node> {
        tree::find(self.table, name)
    }

    pub fn has(&self, name: &str) -> bool {
        self.node(name).is_some()
    }

    /// The given value or the default; an error for a missing key that has none.
    pub fn get<T>(&self, name: &str, read: impl Fn(&Node) -> Result<T, Bad>) -> Result<T> {
        if let Some(node) = self.node(name) {
            return read(node).map_err(|bad| self.refuse(name, node, bad));
        }
        let spec = self.spec(name);
        match spec.default {
            Default::Toml(text) => {
                let node = tree::parse_value(text).map_err(|f| self.error(name, f.message))?;
                read(&node).map_err(|bad| self.refuse(name, &node, bad))
            }
            Default::Required | Default::Absent(_) => Err(self.missing(name)),
        }
    }

    /// The given value, if any.
    pub fn opt<T>(&self, name: &str, read: impl Fn(&Node) -> Result<T, Bad>) -> Result<Option<T>> {
        self.node(name).map(|node| read(node).map_err(|bad| self.refuse(name, node, bad))).transpose()
    }

    /// One word of a [`super::kinds::Kind::Choice`] key, as its place in that list.
    pub fn choice<T: Copy>(&self, name: &str, meanings: &[(&str, T)]) -> Result<T> {
        self.get(name, |node| {
            let word = read::text(node)?;
            meanings.iter().find(|(w, _)| *w == word).map(|(_, t)| *t).ok_or_else(|| {
                let hint = suggest::hint(word, meanings.iter().map(|(w, _)| *w));
                hint.trim_start_matches("; ").into()
            })
        })
    }

    /// A whole number within the limits that the table of keys gives.
    pub fn int(&self, name: &str) -> Result<i64> {
        let (min, max) = match self.spec(name).kind {
            Kind::Int { min, max } => (min, max),
            _ => (i64::MIN, i64::MAX),
        };
        self.get(name, |n| read::integer(n, min, max))
    }

    /// A finite number within the limits that the table of keys gives.
    pub fn number(&self, name: &str) -> Result<f64> {
        let limits = self.number_limits(name);
        self.get(name, |n| read::at_least(n, limits.0, limits.1))
    }

    /// Like [`Reader::number`], for keys without a default.
    pub fn opt_number(&self, name: &str) -> Result<Option<f64>> {
        let limits = self.number_limits(name);
        self.opt(name, |n| read::at_least(n, limits.0, limits.1))
    }

    fn number_limits(&self, name: &str) -> (f64, bool) {
        match self.spec(name).kind {
            Kind::Number { min, strict } => (min, strict),
            _ => (f64::NEG_INFINITY, false),
        }
    }

    pub fn missing(&self, name: &str) -> Error {
        self.error(name, format!("missing; expected {}", self.spec(name).kind.accepts()))
    }

    /// An error about a value, with what would be accepted.
    pub fn refuse(&self, name: &str, node: &Node, bad: Bad) -> Error {
        let reason = if bad.reason.is_empty() { String::new() } else { format!(" ({})", bad.reason) };
        let set = if node.set { " from --set" } else { "" };
        let key = match &bad.key {
            Some(inner) => format!("{}.{inner}", self.dotted(name)),
            None => self.dotted(name),
        };
        let message = format!("got {node}{set}{reason}; expected {}", self.spec(name).kind.accepts());
        error(&key, bad.line.or(node.line).or(self.place.line), message)
    }

    /// An error at a key of this table.
    pub fn error(&self, name: &str, message: impl Into<String>) -> Error {
        self.place.error(name, message.into())
    }
}

/// A config error with its line; the file is added where it is known.
pub fn error(key: &str, line: Option<usize>, message: String) -> Error {
    Error::Config { file: None, line, key: key.to_string(), message }
}
