//! The `molmesh` command: parses nothing, decides nothing, hands over to [`cli`].

mod cli;

fn main() {
    cli::leave(cli::main());
}
