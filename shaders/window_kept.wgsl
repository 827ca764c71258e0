// Outputs that are kept as they are, one element each.

@group(0) @binding(2) var<storage, read_write> output: array<Seen>;

fn kept(place: u32) -> Seen {
    return output[place];
}

fn keep(place: u32, seen: Seen) {
    output[place] = seen;
}
