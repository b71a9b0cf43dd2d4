//! The `molmesh` command: parses nothing, decides nothing, hands over to [`cli`].

mod cli;

fn main() {
    // Not a return: freeing a mesh of a few hundred megabytes that nobody will look at again takes longer than
    // writing it, and `exit` skips that. Everything has been flushed by then.
    std::process::exit(cli::main());
}
