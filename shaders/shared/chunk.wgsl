// The bricks of a chunk. Needs `params`, `halo` and shared/tiles.

// The brick in slot `slot` of the chunk: its own ones come first, then the borrowed ones.
fn brick_in(slot: u32) -> u32 {
    if (slot < params.n_own) {
        return params.first_brick + slot;
    }
    return halo[slot - params.n_own];
}

// The slot of a brick in the chunk, or NONE. Borrowed bricks come after the chunk's own in the order of all.
fn slot_of(brick: u32) -> u32 {
    let own = brick - params.first_brick;
    if (brick == NONE || own < params.n_own) {
        return select(own, NONE, brick == NONE);
    }
    let at = own - params.n_own;
    return select(NONE, halo[params.n_halo + min(at, params.n_halo_slots)], at < params.n_halo_slots);
}
