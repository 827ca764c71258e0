// Where the taps of a thread's output lie. A shader adds `smooth_at`, which makes one output.

// Where the centre of a thread's first output stands in the input, how many taps exist before and after it, its place among the
// outputs along the axis, and its own.
struct Centre {
    here: u32,
    before: u32,
    after: u32,
    k: u32,
    output: u32,
}

fn centre_of(thread: u32) -> Centre {
    let x = thread % p.inner;
    let y = (thread / p.inner) % p.middle;
    let z = thread / (p.inner * p.middle);
    var k = z;
    var i = y;
    var j = x;
    if p.axis == 1u {
        k = y;
        i = z;
    }
    if p.axis == 2u {
        k = x;
        i = z;
        j = y;
    }
    k *= p.strip;
    let centre = p.at + k;
    let here = i * p.in_i + j * p.in_j + (centre - p.start) * p.in_axis;
    let place = k * p.out_axis + i * p.out_i + j * p.out_j;
    return Centre(here, centre, p.n - 1u - centre, k, place);
}

fn one(thread: u32, first_pass: bool) {
    smooth_at(centre_of(thread), first_pass);
}
