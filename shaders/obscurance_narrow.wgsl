// Entries of codes of 8 or 16 bits: the code in the high half, the steps in the low one.

alias Entry = u32;

const TOP: u32 = 0xffffu;

fn entry_of(code: u32, step: u32) -> Entry {
    return (code << 16u) | step;
}

fn code_of(entry: Entry) -> u32 {
    return entry >> 16u;
}

fn step_of(entry: Entry) -> u32 {
    return entry & 0xffffu;
}

// Whether the code of `entry` is greater than that of `below`, whose steps are 0xffff.
fn is_beyond(entry: Entry, below: Entry) -> bool {
    return entry > below;
}
