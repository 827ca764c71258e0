// What shaders of pyramid levels share: cells, their counts, the values that they stand for. Needs double.wgsl.

const MEAN: u32 = 0u;
const LEAST: u32 = 1u;
const GREATEST: u32 = 2u;
const FIRST: u32 = 3u;
const MOMENTS: u32 = 4u;
const SPREAD: u32 = 5u; // moments of a channel that is a standard deviation
const MAP_MEAN: u32 = 6u; // of an occlusion map's cells (map_pool.wgsl)
const MAP_VARIANCE: u32 = 7u;

// Set in a cell's count where it covers only voxels that a mask excludes.
const EXCLUDED: u32 = 0x80000000u;

// Unrounded: a sum (of means) or one of the values, voxels that entered, and of moments the sum of the voxels' variances and
// the sum of squared deviations of their means.
struct Cell {
    value: vec2<u32>,
    n: u32,
    inner: vec2<u32>,
    between: vec2<u32>,
}

fn words_of(kind: u32) -> u32 {
    return select(3u, 7u, kind == MOMENTS || kind == SPREAD);
}

fn pair_at(at: u32) -> vec2<u32> {
    return vec2<u32>(input[at], input[at + 1u]);
}

fn cell_from(index: u32, kind: u32) -> Cell {
    let at = index * words_of(kind);
    var cell = Cell(pair_at(at), input[at + 2u], vec2<u32>(), vec2<u32>());
    if kind >= MOMENTS {
        cell.inner = pair_at(at + 3u);
        cell.between = pair_at(at + 5u);
    }
    return cell;
}

fn count_of(n: u32) -> vec2<u32> {
    return of_integer(vec2<u32>(n & ~EXCLUDED, 0u));
}
