// Which part of which line along z or y a thread takes. A shader adds `walk`, which makes the outputs of one block of one line.

// Where a thread's line starts in the input and the output, and the number of its block.
struct Line {
    input: u32,
    output: u32,
    block: i32,
}

fn line_of(thread: u32) -> Line {
    let i = thread % p.lines;
    let b = (thread / p.lines) % p.blocks;
    let j = thread / (p.lines * p.blocks);
    return Line(i * p.in_i + j * p.in_j, i * p.out_i + j * p.out_j, i32(b));
}

fn one(thread: u32, first_pass: bool) {
    walk(line_of(thread), first_pass);
}
