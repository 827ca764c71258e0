// Arithmetic of sums that 32 bits hold.

fn plus(a: Sum, b: Sum) -> Sum {
    return a + b;
}

fn minus(a: Sum, b: Sum) -> Sum {
    return a - b;
}
