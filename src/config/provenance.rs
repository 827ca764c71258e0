//! What an output records of the config that made it.

/// The config without comments and without what cannot change a voxel: budget, threads, brick, device, scratch, and where
/// the outputs lie. So outputs of equal runs are equal, metadata included, however they were computed.
pub fn provenance(text: &str) -> String {
    let Ok(mut table) = text.parse::<toml::Table>() else { return text.to_string() };
    if let Some(run) = table.get_mut("run").and_then(|r| r.as_table_mut()) {
        run.retain(|key, _| ["region", "lanes"].contains(&key));
        if run.is_empty() {
            table.remove("run");
        }
    }
    if let Some(outputs) = table.get_mut("output").and_then(|o| o.as_table_mut()) {
        for (_, output) in outputs.iter_mut() {
            if let Some(output) = output.as_table_mut() {
                output.remove("path");
            }
        }
    }
    table.remove("pareto");
    toml::to_string(&table).unwrap_or_else(|_| text.to_string())
}

#[cfg(test)]
mod tests {
    use super::provenance;

    #[test]
    fn runs_that_differ_in_budget_and_place_only_record_the_same() {
        let one = "[run]\nmemory = '1GiB' # much\nthreads = 2\n[input.a]\npath = 'a.npy'\n[output.b]\npath = 'x.zarr'\nfrom = 'a'\n";
        let two = "[input.a]\npath = 'a.npy'\n[output.b]\nfrom = 'a'\npath = 'elsewhere/y.zarr'\n";
        assert_eq!(provenance(one), provenance(two));
        assert!(provenance("[run]\nregion = [[0, 1], [0, 1], [0, 1]]\n").contains("region"));
    }
}
