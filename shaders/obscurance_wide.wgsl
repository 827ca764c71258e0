// Entries of codes of up to 32 bits: the code, the steps.

alias Entry = vec2<u32>;

const TOP: u32 = 0xffffffffu;

fn entry_of(code: u32, step: u32) -> Entry {
    return Entry(code, step);
}

fn code_of(entry: Entry) -> u32 {
    return entry.x;
}

fn step_of(entry: Entry) -> u32 {
    return entry.y;
}

// Whether the code of `entry` is greater than that of `below`.
fn is_beyond(entry: Entry, below: Entry) -> bool {
    return entry.x > below.x;
}
