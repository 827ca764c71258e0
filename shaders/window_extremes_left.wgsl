// Extremes that the pass before left, one element each.

@group(0) @binding(1) var<storage, read> input: array<Seen>;

fn seen_at(index: u32, packed: bool) -> Seen {
    return Seen(input[index]);
}
