//! The `molmesh` command: parses nothing, decides nothing, hands over to [`cli`].

mod cli;

#[cfg(target_env = "musl")]
#[global_allocator]
static HEAP: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() {
    cli::leave(cli::main());
}
