// Windows along x, whose rows lie one after the other in memory: a workgroup takes 64 rows of one span of outputs, brings them
// here in tiles of 64 x `COLUMNS` so that neighbouring threads touch neighbouring voxels, and each thread walks a row of the
// tiles. A shader adds `COLUMNS`, a power of two, `Cell`, and `walk_rows`.

// At most 16 KiB for both, which every adapter has; half of it lets twice as many threads be there.
var<workgroup> ahead: array<Cell, 64u * COLUMNS>;
var<workgroup> made: array<Cell, 64u * COLUMNS>;

// Turned by the row, so that threads which walk their rows side by side meet no bank of memory twice.
fn slot_of(row: u32, column: u32) -> u32 {
    return row * COLUMNS + (column ^ (row & (COLUMNS - 1u)));
}

// A thread asks for so many voxels before it waits for the first.
const BATCH: u32 = 4u;

// Entry `k` of a tile, which thread k modulo 64 brings here and back: row of the tile, column.
fn row_of(k: u32) -> u32 {
    return k / COLUMNS;
}

fn column_of(k: u32) -> u32 {
    return k % COLUMNS;
}

fn place_of(k: u32) -> u32 {
    return slot_of(row_of(k), column_of(k));
}

fn bring_made(k: u32, batch: array<Cell, BATCH>) {
    made[place_of(k)] = batch[0];
    made[place_of(k + 64u)] = batch[1];
    made[place_of(k + 128u)] = batch[2];
    made[place_of(k + 192u)] = batch[3];
}

fn bring_ahead(k: u32, batch: array<Cell, BATCH>) {
    ahead[place_of(k)] = batch[0];
    ahead[place_of(k + 64u)] = batch[1];
    ahead[place_of(k + 128u)] = batch[2];
    ahead[place_of(k + 192u)] = batch[3];
}

@compute @workgroup_size(64)
fn rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let number = group.y * groups.x + group.x;
    let first = number / p.blocks * 64u;
    if first < p.lines {
        walk_rows(first, i32(number % p.blocks), local);
    }
}
