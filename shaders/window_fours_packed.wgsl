// Four neighbouring packed voxels, of 8 or 16 bits. Rows are of whole fours; positions count them. Needs a uniform `p` with
// `packing` and `flip`, and the `input`.

fn codes_of_8(four: u32) -> vec4<u32> {
    let word = input[four] ^ (p.flip * 0x01010101u);
    return vec4<u32>(word & 0xffu, (word >> 8u) & 0xffu, (word >> 16u) & 0xffu, word >> 24u);
}

fn codes_of_16(four: u32) -> vec4<u32> {
    let flips = p.flip * 0x00010001u;
    let low = input[2u * four] ^ flips;
    let high = input[2u * four + 1u] ^ flips;
    return vec4<u32>(low & 0xffffu, low >> 16u, high & 0xffffu, high >> 16u);
}

fn codes_at(four: u32) -> vec4<u32> {
    if (parts & 2u) != 0u {
        return codes_of_16(four);
    }
    return codes_of_8(four);
}
