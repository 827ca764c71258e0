// Cells of three words, mean (high, low) and variance, or packed voxels in their place. Needs a uniform `p` with `packing` and
// `sign`, and the `input`.

struct Cell {
    mean: vec2<f32>,
    variance: f32,
}

fn integer_at(index: u32) -> f32 {
    let code = unpacked(input[index >> p.packing], index, p.packing);
    return f32(i32(code ^ p.sign) - i32(p.sign));
}

fn cell_at(index: u32, packed: bool) -> Cell {
    if packed {
        return Cell(vec2<f32>(integer_at(index), 0.0), 0.0);
    }
    let start = 3u * index;
    let mean = vec2<f32>(bitcast<f32>(input[start]), bitcast<f32>(input[start + 1u]));
    return Cell(mean, bitcast<f32>(input[start + 2u]));
}

// What a cell adds to a variance about `mean`.
fn spread(cell: Cell, mean: vec2<f32>, w: f32) -> f32 {
    let d = distance(cell.mean, mean);
    return w * (cell.variance + d * d);
}
