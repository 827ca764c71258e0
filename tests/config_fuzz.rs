//! Configs that nobody would write: thousands of damaged variants of the shipped ones parse or are refused, and a refusal
//! says where and why. Nothing panics, hangs or answers without words.

mod common;

use std::path::Path;

use common::hash;

/// One random edit: a byte replaced, a span deleted, doubled or swapped with another, a token from a list put in.
fn damage(text: &[u8], seed: u64) -> Vec<u8> {
    const TOKENS: [&str; 14] = [
        "[",
        "]",
        "=",
        "\"",
        "-1",
        "1e999",
        "nan",
        "[[",
        "\n[stage.x]\n",
        "9223372036854775808",
        "{",
        "'''",
        "\u{0}",
        "\u{1F600}",
    ];
    let mut out = text.to_vec();
    for step in 0..1 + hash(seed, 0) % 4 {
        let pick = |k: u64, n: usize| (hash(seed, 10 * step + k) % n.max(1) as u64) as usize;
        let at = pick(1, out.len());
        let end = (at + 1 + pick(2, 40)).min(out.len());
        match pick(3, 4) {
            0 => out[at] = hash(seed, step) as u8,
            1 => drop(out.drain(at..end)),
            2 => {
                let span = out[at..end].to_vec();
                let to = pick(4, out.len());
                out.splice(to..to, span);
            }
            _ => drop(out.splice(at..at, TOKENS[pick(5, TOKENS.len())].bytes())),
        }
        if out.is_empty() {
            break;
        }
    }
    out
}

#[test]
fn damaged_configs_parse_or_are_refused_in_words() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let mut texts: Vec<Vec<u8>> = Vec::new();
    for entry in std::fs::read_dir(&dir).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "toml") {
            texts.push(std::fs::read(path).unwrap());
        }
    }
    let (mut accepted, mut refused) = (0, 0);
    for seed in 0..6000u64 {
        let text = damage(&texts[(seed % texts.len() as u64) as usize], seed);
        let text = String::from_utf8_lossy(&text).into_owned();
        match occlude::config::parse(&text, Path::new("/somewhere/config.toml"), &[]) {
            Ok(config) => {
                accepted += 1;
                occlude::config::config_hash(&config);
            }
            Err(error) => {
                refused += 1;
                assert_eq!(error.exit_code(), 2, "{error}");
                assert!(error.to_string().len() > 30, "{error}");
            }
        }
    }
    assert!(accepted > 100 && refused > 100, "{accepted} accepted, {refused} refused");
}
