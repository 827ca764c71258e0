// Sums that the pass before left, one element each.

@group(0) @binding(1) var<storage, read> input: array<Sum>;
@group(0) @binding(2) var<storage, read_write> output: array<Sum>;

fn term(index: u32, packed: bool) -> Sum {
    return input[index];
}
