//! The `molmesh` command.

mod cli;

#[cfg(target_env = "musl")]
#[global_allocator]
static HEAP: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() {
    cli::leave(cli::main());
}
