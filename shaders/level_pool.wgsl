// One step of a pyramid: a cell joins the up to 2 x 2 x 2 finer ones that it covers, over z and y in the tree (00 + 01) +
// (10 + 11), then over x. One thread makes one cell.
//
// Agrees bit for bit with src/kernel/reduce (Cells): the same tree, in f64 (double.wgsl). Parameters: src/gpu/levels.rs,
// struct Join.
// Bindings, group 0: 0 uniform Join; 1 storage, read: bits of f32 voxels (`first`) or cells (`next`); 2 storage, written: cells
// of 3 words (value, voxels) or 7 (and inner, between); 3 storage, read: bits of f32 means beside the voxels (moments); 4 storage,
// read: bytes of a mask of the voxels, 1 where one is needed.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Join {
    out_z: u32,     // cells
    out_y: u32,
    out_x: u32,
    in_z: u32,      // finer cells
    in_y: u32,
    in_x: u32,
    step_z: u32,    // 2 where the axis is halved, else 1
    step_y: u32,
    step_x: u32,
    start: u32,     // voxel 0 among the input's, and its strides; of cells dense
    plane: u32,
    row: u32,
    mean_start: u32, // the same of the means
    mean_plane: u32,
    mean_row: u32,
    kind: u32,
    threads: u32,
    mask_start: u32, // the same of the mask, in bytes
    mask_plane: u32,
    mask_row: u32,   // 0: there is none
}

@group(0) @binding(0) var<uniform> p: Join;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> means: array<u32>;
@group(0) @binding(4) var<storage, read> needed: array<u32>;

fn is_nan32(bits: u32) -> bool {
    return (bits & 0x7fffffffu) > 0x7f800000u;
}

fn is_excluded(z: u32, y: u32, x: u32) -> bool {
    if p.mask_row == 0u {
        return false;
    }
    let at = p.mask_start + z * p.mask_plane + y * p.mask_row + x;
    return unpacked(needed[at / 4u], at, 2u) == 0u;
}

// A voxel of which the value, or the mean or variance, is NaN does not count; where values are chosen NaN itself says so.
fn voxel_at(z: u32, y: u32, x: u32) -> Cell {
    let bits = input[p.start + z * p.plane + y * p.row + x];
    if p.kind < MOMENTS {
        if p.kind == MEAN && is_nan32(bits) {
            return Cell();
        }
        return Cell(widened(bits), 1u, vec2<u32>(), vec2<u32>());
    }
    let mean = means[p.mean_start + z * p.mean_plane + y * p.mean_row + x];
    if is_nan32(bits) || is_nan32(mean) {
        return Cell();
    }
    let v = widened(bits);
    var inner = v;
    if p.kind == SPREAD {
        inner = product_of(v, magnitude_of(v));
    }
    return Cell(widened(mean), 1u, inner, vec2<u32>());
}

fn finer(z: u32, y: u32, x: u32, voxels: bool) -> Cell {
    if voxels {
        var cell = voxel_at(z, y, x);
        cell.n |= select(0u, EXCLUDED, is_excluded(z, y, x));
        return cell;
    }
    return cell_from((z * p.in_y + y) * p.in_x + x, p.kind);
}

// The value of two where one is chosen.
fn chosen(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    if is_nan64(a) {
        return b;
    }
    var better = false;
    if p.kind == LEAST {
        better = is_less64(b, a);
    }
    if p.kind == GREATEST {
        better = is_less64(a, b);
    }
    return select(a, b, better);
}

fn plus(a: Cell, b: Cell) -> Cell {
    if p.kind != MEAN && p.kind < MOMENTS {
        return Cell(chosen(a.value, b.value), a.n + b.n, vec2<u32>(), vec2<u32>());
    }
    var both = Cell(sum_of(a.value, b.value), a.n + b.n, vec2<u32>(), vec2<u32>());
    if p.kind >= MOMENTS {
        both.inner = sum_of(a.inner, b.inner);
        both.between = sum_of(a.between, b.between);
    }
    return both;
}

fn mean_of(cell: Cell) -> vec2<u32> {
    return quotient_of(cell.value, count_of(max(cell.n & ~EXCLUDED, 1u)));
}

// A finer cell whose deviations are taken from another mean.
fn moved(cell: Cell, mean: vec2<u32>) -> Cell {
    let d = sum_of(mean_of(cell), negated(mean));
    let more = product_of(count_of(cell.n), product_of(d, d));
    return Cell(cell.value, cell.n, cell.inner, sum_of(cell.between, more));
}

// The finer cells by 4 x + 2 z + y: over y, then z, then x.
const LEFT: array<u32, 7> = array<u32, 7>(0u, 2u, 4u, 6u, 0u, 4u, 0u);
const RIGHT: array<u32, 7> = array<u32, 7>(1u, 3u, 5u, 7u, 2u, 6u, 4u);
// By z, then y, then x.
const IN_TURN: array<u32, 8> = array<u32, 8>(0u, 4u, 1u, 5u, 2u, 6u, 3u, 7u);

// What a finer cell of excluded voxels leaves in one that covers others.
fn left_out() -> Cell {
    var cell = Cell();
    if p.kind != MEAN && p.kind < MOMENTS {
        cell.value = vec2<u32>(0u, 0x7ff80000u);
    }
    return cell;
}

// All that a cell covers; with their deviations from its mean. Excluded ones enter only where there are no others.
fn all_of(z: u32, y: u32, x: u32, voxels: bool, mean: vec2<u32>, again: bool) -> Cell {
    var cells: array<Cell, 8>;
    var there: array<bool, 8>;
    var any_needed = false;
    for (var i = 0u; i < 8u; i += 1u) {
        let at = vec3<u32>((i >> 1u) & 1u, i & 1u, i >> 2u);
        let inside = z + at.x < p.in_z && y + at.y < p.in_y && x + at.z < p.in_x;
        there[i] = inside && at.x < p.step_z && at.y < p.step_y && at.z < p.step_x;
        if there[i] {
            cells[i] = finer(z + at.x, y + at.y, x + at.z, voxels);
            any_needed = any_needed || (cells[i].n & EXCLUDED) == 0u;
        }
    }
    for (var i = 0u; i < 8u; i += 1u) {
        if any_needed && (cells[i].n & EXCLUDED) != 0u {
            cells[i] = left_out();
        }
        cells[i].n &= ~EXCLUDED;
        if there[i] && again {
            cells[i] = moved(cells[i], mean);
        }
    }
    var turn = IN_TURN;
    var left = LEFT;
    var right = RIGHT;
    for (var k = 0u; k < 7u; k += 1u) {
        var a = left[k];
        var b = right[k];
        if p.kind == FIRST {
            a = 0u;
            b = turn[k + 1u];
        }
        if there[b] {
            cells[a] = plus(cells[a], cells[b]);
        }
    }
    cells[0].n |= select(EXCLUDED, 0u, any_needed);
    return cells[0];
}

fn one(thread: u32, voxels: bool) {
    let x = (thread % p.out_x) * p.step_x;
    let y = ((thread / p.out_x) % p.out_y) * p.step_y;
    let z = (thread / (p.out_x * p.out_y)) * p.step_z;
    var cell = Cell();
    // Moments: once for the mean, once more for the deviations from it.
    var mean = vec2<u32>();
    let rounds = select(1u, 2u, p.kind >= MOMENTS);
    for (var k = 0u; k < rounds; k += 1u) {
        cell = all_of(z, y, x, voxels, mean, k == 1u);
        if k + 1u < rounds {
            mean = mean_of(cell);
        }
    }
    let to = thread * words_of(p.kind);
    output[to] = cell.value.x;
    output[to + 1u] = cell.value.y;
    output[to + 2u] = cell.n;
    if p.kind >= MOMENTS {
        output[to + 3u] = cell.inner.x;
        output[to + 4u] = cell.inner.y;
        output[to + 5u] = cell.between.x;
        output[to + 6u] = cell.between.y;
    }
}
