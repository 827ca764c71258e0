//! TOML as a tree that remembers lines, and the `--set` edits to it.

use std::fmt;

use toml::de::{DeString, DeTable, DeValue};

/// Key and value, in the order of the file.
pub type Table = Vec<(String, Node)>;

/// A value and where it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    pub value: Value,
    /// Line of its key (of the element, inside arrays), from 1; `None` for defaults and `--set`.
    pub line: Option<usize>,
    /// Came from `--set`.
    pub set: bool,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    Text(String),
    Int(i64),
    Float(f64),
    Bool(bool),
    /// Dates and times: no key takes them, but messages show them.
    Time(String),
    List(Vec<Node>),
    Table(Table),
}

/// Entry of a table by key.
pub fn find<'a>(table: &'a Table, key: &str) -> Option<&'a Node> {
    table.iter().find(|(k, _)| k == key).map(|(_, node)| node)
}

/// What is wrong with a text, at which key and in which line.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    pub line: Option<usize>,
    /// Dotted; empty where the text is no TOML.
    pub key: String,
    pub message: String,
}

/// Byte offset to line: one pass over the text, then look-ups.
struct Lines(Vec<usize>);

impl Lines {
    fn new(text: &str) -> Lines {
        Lines(text.bytes().enumerate().filter(|(_, b)| *b == b'\n').map(|(i, _)| i).collect())
    }

    fn at(&self, byte: usize) -> usize {
        self.0.partition_point(|&newline| newline < byte) + 1
    }
}

/// Parses a whole document.
pub fn parse(text: &str) -> Result<Table, Fault> {
    let lines = Lines::new(text);
    let table = DeTable::parse(text).map_err(|e| fault(&e, Some(&lines)))?;
    convert_table(table.get_ref(), Some(&lines))
}

/// Parses one value, such as a default or the right side of `--set`.
pub fn parse_value(text: &str) -> Result<Node, Fault> {
    let value = DeValue::parse(text.trim()).map_err(|e| fault(&e, None))?;
    Ok(Node { value: convert(value.get_ref(), None)?, line: None, set: false })
}

fn fault(e: &toml::de::Error, lines: Option<&Lines>) -> Fault {
    let line = lines.and_then(|l| e.span().map(|span| l.at(span.start)));
    Fault { line, key: String::new(), message: format!("not valid TOML: {}", e.message().trim().replace('\n', "; ")) }
}

fn convert_table(table: &DeTable, lines: Option<&Lines>) -> Result<Table, Fault> {
    let entry = |(k, v): (&toml::Spanned<DeString>, &toml::Spanned<DeValue>)| {
        let (key, line) = (k.get_ref().to_string(), lines.map(|l| l.at(k.span().start)));
        let inside = |f: Fault| Fault {
            key: if f.key.is_empty() { key.clone() } else { format!("{key}.{}", f.key) },
            line: f.line.or(line),
            ..f
        };
        let value = convert(v.get_ref(), lines).map_err(inside)?;
        Ok((key, Node { value, line, set: false }))
    };
    table.iter().map(entry).collect()
}

fn convert(value: &DeValue, lines: Option<&Lines>) -> Result<Value, Fault> {
    let out_of_range = |what: String| {
        let message = format!("got {what}, which does not fit in 64 bits; expected {} to {}", i64::MIN, i64::MAX);
        Fault { line: None, key: String::new(), message }
    };
    Ok(match value {
        DeValue::String(s) => Value::Text(s.to_string()),
        DeValue::Integer(i) => {
            Value::Int(i64::from_str_radix(i.as_str(), i.radix()).map_err(|_| out_of_range(i.to_string()))?)
        }
        DeValue::Float(f) => Value::Float(f.as_str().parse().map_err(|_| out_of_range(f.to_string()))?),
        DeValue::Boolean(b) => Value::Bool(*b),
        DeValue::Datetime(d) => Value::Time(d.to_string()),
        DeValue::Array(items) => {
            let item = |v: &toml::Spanned<DeValue>| {
                let line = lines.map(|l| l.at(v.span().start));
                let value = convert(v.get_ref(), lines).map_err(|f| Fault { line: f.line.or(line), ..f })?;
                Ok(Node { value, line, set: false })
            };
            Value::List(items.iter().map(item).collect::<Result<_, Fault>>()?)
        }
        DeValue::Table(table) => Value::Table(convert_table(table, lines)?),
    })
}

/// One `--set`: the dotted key, split by TOML's rules, and its value.
#[derive(Debug, Clone, PartialEq)]
pub struct Edit {
    pub path: Vec<String>,
    pub node: Node,
    /// The value as TOML, for the provenance text.
    toml: String,
}

impl Edit {
    /// From `key=value`; the value is TOML, or a plain string where that fails.
    pub fn parse(text: &str) -> Result<Edit, String> {
        let at = equals_sign(text).ok_or_else(|| format!("--set {text}: expected key=value, e.g. run.memory=1GiB"))?;
        let (key, value) = (text[..at].trim(), text[at + 1..].trim());
        let keys = toml_edit::Key::parse(key)
            .map_err(|_| format!("--set {text}: `{key}` is not a dotted TOML key, e.g. stage.ao.radius"))?;
        let (mut node, toml) = match parse_value(value) {
            Ok(node) => (node, value.to_string()),
            Err(_) => {
                let node = Node { value: Value::Text(value.to_string()), line: None, set: false };
                (node, toml_edit::Value::from(value).to_string())
            }
        };
        mark_set(&mut node);
        Ok(Edit { path: keys.iter().map(|k| k.get().to_string()).collect(), node, toml })
    }

    /// The key as one would write it in the file.
    pub fn key(&self) -> String {
        self.path.join(".")
    }

    /// Puts the value into the tree, making tables on the way.
    pub fn apply(&self, root: &mut Table) -> Result<(), String> {
        let Some((last, parents)) = self.path.split_last() else { return Err("the key is empty".into()) };
        let mut table = root;
        for (depth, name) in parents.iter().enumerate() {
            let at = table.iter().position(|(k, _)| k == name).unwrap_or_else(|| {
                table.push((name.clone(), Node { value: Value::Table(Vec::new()), line: None, set: true }));
                table.len() - 1
            });
            let node = &mut table[at].1;
            let shown = node.to_string();
            let Value::Table(inner) = &mut node.value else {
                return Err(format!("`{}` is {shown}, not a table", self.path[..=depth].join(".")));
            };
            table = inner;
        }
        match table.iter_mut().find(|(k, _)| k == last) {
            Some((_, node)) => *node = self.node.clone(),
            None => table.push((last.clone(), self.node.clone())),
        }
        Ok(())
    }

    /// The same edit on the text that outputs keep as provenance. Never fails: what cannot be placed is left to
    /// [`Edit::apply`] to refuse.
    pub fn apply_to_text(&self, document: &mut toml_edit::DocumentMut) {
        let Some((last, parents)) = self.path.split_last() else { return };
        let mut table: &mut dyn toml_edit::TableLike = document.as_table_mut();
        for name in parents {
            let item = table.entry(name).or_insert_with(|| {
                let mut made = toml_edit::Table::new();
                made.set_implicit(true);
                toml_edit::Item::Table(made)
            });
            match item.as_table_like_mut() {
                Some(inner) => table = inner,
                None => return,
            }
        }
        if let Ok(value) = self.toml.parse::<toml_edit::Value>() {
            table.insert(last, toml_edit::Item::Value(value));
        }
    }
}

/// The first `=` that is not inside a quoted part of the key.
fn equals_sign(text: &str) -> Option<usize> {
    let mut quote = None;
    for (i, c) in text.char_indices() {
        match (quote, c) {
            (None, '=') => return Some(i),
            (None, '"' | '\'') => quote = Some(c),
            (Some(q), c) if q == c => quote = None,
            _ => {}
        }
    }
    None
}

fn mark_set(node: &mut Node) {
    node.set = true;
    match &mut node.value {
        Value::List(items) => items.iter_mut().for_each(mark_set),
        Value::Table(entries) => entries.iter_mut().for_each(|(_, n)| mark_set(n)),
        _ => {}
    }
}

/// As messages show a value: short, on one line.
impl fmt::Display for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.value {
            Value::Text(s) if s.chars().count() > 60 => write!(f, "{:?}...", s.chars().take(60).collect::<String>()),
            Value::Text(s) => write!(f, "{s:?}"),
            Value::Int(i) => write!(f, "{i}"),
            Value::Float(v) => write!(f, "{v:?}"),
            Value::Bool(b) => write!(f, "{b}"),
            Value::Time(t) => write!(f, "{t}"),
            Value::Table(entries) => {
                let shown = |(k, n): &(String, Node)| match n.value {
                    Value::Table(_) => format!("{k} = {{..}}"),
                    _ => format!("{k} = {n}"),
                };
                let first: Vec<String> = entries.iter().take(4).map(shown).collect();
                write!(f, "a table {{ {}{} }}", first.join(", "), if entries.len() > 4 { ", ..." } else { "" })
            }
            Value::List(items) => {
                let shown: Vec<String> = items.iter().take(8).map(Node::to_string).collect();
                write!(f, "[{}{}]", shown.join(", "), if items.len() > 8 { ", ..." } else { "" })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_shown_short() {
        let t = parse("b = { constant = inf }\nc = { a = 1, b = { x = 2 }, c = 3, d = 4, e = 5 }\n").unwrap();
        assert_eq!(find(&t, "b").unwrap().to_string(), "a table { constant = inf }");
        assert_eq!(find(&t, "c").unwrap().to_string(), "a table { a = 1, b = {..}, c = 3, d = 4, ... }");
    }

    #[test]
    fn lines_are_those_of_the_keys() {
        let t = parse("a = 1\n\n[b.c]\nd = [\n 1,\n 2]\n").unwrap();
        assert_eq!(find(&t, "a").unwrap().line, Some(1));
        let Value::Table(b) = &find(&t, "b").unwrap().value else { panic!() };
        let c = find(b, "c").unwrap();
        assert_eq!(c.line, Some(3));
        let Value::Table(c) = &c.value else { panic!() };
        let d = find(c, "d").unwrap();
        assert_eq!(d.line, Some(4));
        let Value::List(items) = &d.value else { panic!() };
        assert_eq!(items[1].line, Some(6));
    }

    #[test]
    fn broken_text_names_the_line() {
        assert_eq!(parse("a = 1\nb = [1,\nc = 2\n").unwrap_err().line.map(|l| l >= 2), Some(true));
        assert_eq!(parse("a = 1\na = 2\n").unwrap_err().line, Some(2));
    }

    #[test]
    fn numbers_of_more_than_64_bits_name_their_key_and_line() {
        for (text, key, line) in [
            ("a = 99999999999999999999", "a", 1),
            ("[run]\nthreads = 99999999999999999999\n", "run.threads", 2),
            ("[stage.ao]\nop = \"box\"\nradius = [1,\n 99999999999999999999, 2]\n", "stage.ao.radius", 4),
            ("[stage.ao]\nwhere = { input = \"ct\", min = -99999999999999999999 }\n", "stage.ao.where.min", 2),
        ] {
            let fault = parse(text).unwrap_err();
            assert_eq!((fault.key.as_str(), fault.line), (key, Some(line)), "{text}");
            let message = &fault.message;
            assert!(
                message.contains("99999999999999999999") && message.contains("to 9223372036854775807"),
                "{message}"
            );
        }
    }

    #[test]
    fn edits_take_toml_or_plain_text_and_quoted_keys() {
        let mut t = parse("[run]\nmemory = 5\n").unwrap();
        for (text, path, shown) in [
            ("run.memory=1GiB", "run/memory", "\"1GiB\""),
            ("stage.\"a.b=c\".radius = [1, 2, 3]", "stage/a.b=c/radius", "[1, 2, 3]"),
            ("x=", "x", "\"\""),
            ("y=a = b", "y", "\"a = b\""),
        ] {
            let edit = Edit::parse(text).unwrap();
            assert_eq!(edit.path.join("/"), path);
            edit.apply(&mut t).unwrap();
            let mut node = Node { value: Value::Table(t.clone()), line: None, set: false };
            for key in path.split('/') {
                let Value::Table(inner) = node.value else { panic!() };
                node = find(&inner, key).unwrap().clone();
            }
            assert_eq!(node.to_string(), shown);
            assert!(node.set);
        }
        assert!(Edit::parse("run.memory").is_err());
        assert!(Edit::parse("run..memory=1").is_err());
        assert!(Edit::parse("run.memory.deep=1").unwrap().apply(&mut t).unwrap_err().contains("not a table"));
    }

    #[test]
    fn text_with_edits_is_what_the_tree_holds() {
        let text = "# keep me\n[run]\nthreads = 1\n[stage.ao]\nwhere = { input = \"ct\", min = 1 }\n";
        let mut tree = parse(text).unwrap();
        let mut document: toml_edit::DocumentMut = text.parse().unwrap();
        for set in ["run.threads=4", "stage.ao.where.min=200", "output.ao.path=x y", "run.region=[[0,1],[0,1],[0,1]]"] {
            let edit = Edit::parse(set).unwrap();
            edit.apply(&mut tree).unwrap();
            edit.apply_to_text(&mut document);
        }
        let written = document.to_string();
        assert!(written.contains("# keep me"));
        let plain = |t: &Table| format!("{}", toml_of(t));
        assert_eq!(plain(&parse(&written).unwrap()), plain(&tree));
    }

    fn toml_of(t: &Table) -> toml::Table {
        super::super::read::toml_table(t)
    }
}
