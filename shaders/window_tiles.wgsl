// Windows along x, whose rows lie one after the other in memory: a workgroup takes 64 rows of one span of outputs, brings them
// here in tiles of 64 x `COLUMNS` so that neighbouring threads touch neighbouring voxels, and each thread walks a row of the
// tiles. A shader adds `COLUMNS`, a power of two of at least 4, `Cell`, and `walk_rows`.

// At most 16 KiB for both, which every adapter has; half of it lets twice as many threads be there.
var<workgroup> ahead: array<Cell, 64u * COLUMNS>;
var<workgroup> made: array<Cell, 64u * COLUMNS>;

// Turned by the row, so that threads which walk their rows side by side meet no bank of memory twice.
fn slot_of(row: u32, column: u32) -> u32 {
    return row * COLUMNS + (column ^ (row & (COLUMNS - 1u)));
}

// Rows from one that a thread brings to the next one; it always brings the same column.
const APART: u32 = 64u / COLUMNS;

fn row_of(local: u32) -> u32 {
    return local / COLUMNS;
}

fn column_of(local: u32) -> i32 {
    return i32(local % COLUMNS);
}

// Where row `first + row` starts among rows of `pitch`; one beyond the end counts as the last.
fn start_of(first: u32, row: u32, pitch: u32) -> u32 {
    return min(first + row, p.lines - 1u) * pitch;
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
