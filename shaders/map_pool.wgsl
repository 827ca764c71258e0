// One axis of a step of Penner's chain: a cell pools the six finer cells that the two blurred cells it covers see. Means are
// unevaluated pairs of f32 and enter by their distances to cell 2i, so that nothing cancels and constants stay what they are.
// One thread makes one cell.
//
// Agrees with src/kernel/occlusion_map (coarsen) within facts::tolerance; weights come from there, in f64 and rounded.
// Parameters: src/gpu/maps.rs, struct Pool.
// Bindings, group 0: 0 uniform Pool; 1 storage, read: packed voxels (`first`) or cells (`next`); 2 storage, written: cells of
// three words: mean (high, low), variance; 3 storage, read: bits of f32 weights, six for each output along the axis.
// Workgroup: 64 x 1 x 1, groups counted over x, then y. No workgroup memory, no atomics: an output has one writer.

struct Pool {
    out_z: u32,     // extents of the output, dense
    out_y: u32,
    out_x: u32,
    in_z: u32,      // strides of the input; along x it is 1
    in_y: u32,
    axis: u32,      // 0, 1, 2: z, y, x
    shift_z: u32,   // where output 0 lies in the input along the other axes
    shift_y: u32,
    shift_x: u32,
    first: i32,     // tap 0 of output 0 in the input, along the axis
    least: i32,     // the first and the last cell that exist there; taps beyond weigh nothing
    most: i32,
    weights: u32,   // where the axis' weights start
    packing: u32,   // log2 of voxels per word
    sign: u32,      // the sign bit of a packed voxel, or 0
    zero: u32,      // 0, which no compiler knows
    threads: u32,
    spare_0: u32,
    spare_1: u32,
    spare_2: u32,
}

@group(0) @binding(0) var<uniform> p: Pool;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
@group(0) @binding(3) var<storage, read> weights: array<u32>;

fn one(thread: u32, packed: bool) {
    let x = thread % p.out_x;
    let y = (thread / p.out_x) % p.out_y;
    let z = thread / (p.out_x * p.out_y);
    let at = vec3<u32>(z + p.shift_z, y + p.shift_y, x + p.shift_x);
    let strides = vec3<u32>(p.in_z, p.in_y, 1u);
    let along = vec3<u32>(z, y, x)[p.axis];
    // What lies before the line along the axis.
    let line = dot(at * strides, vec3<u32>(1u)) - at[p.axis] * strides[p.axis];
    var cells: array<Cell, 6>;
    for (var k = 0; k < 6; k += 1) {
        let place = clamp(p.first + 2 * i32(along) + k, p.least, p.most);
        cells[k] = cell_at(line + u32(place) * strides[p.axis], packed);
    }
    let start = p.weights + 6u * along;
    var moved = 0.0;
    for (var k = 0u; k < 6u; k += 1u) {
        moved += bitcast<f32>(weights[start + k]) * distance(cells[k].mean, cells[2].mean);
    }
    let mean = add(cells[2].mean, alone(moved));
    var variance = 0.0;
    for (var k = 0u; k < 6u; k += 1u) {
        variance += spread(cells[k], mean, bitcast<f32>(weights[start + k]));
    }
    let to = 3u * thread;
    output[to] = bitcast<u32>(mean.x);
    output[to + 1u] = bitcast<u32>(mean.y);
    output[to + 2u] = bitcast<u32>(variance);
}
