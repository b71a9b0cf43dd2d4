// Bricks of a chunk. Requires `params`, `halo` and shared/tiles.

// Brick in slot `slot` of the chunk: own bricks first, then the halo.
fn brick_in(slot: u32) -> u32 {
    if (slot < params.n_own) {
        return params.first_brick + slot;
    }
    return halo[slot - params.n_own];
}

// Slot of a brick in the chunk, or NONE. Halo bricks have higher numbers than own bricks.
fn slot_of(brick: u32) -> u32 {
    let own = brick - params.first_brick;
    if (brick == NONE || own < params.n_own) {
        return select(own, NONE, brick == NONE);
    }
    let at = own - params.n_own;
    return select(NONE, halo[params.n_halo + min(at, params.n_halo_slots)], at < params.n_halo_slots);
}
