// SPDX-License-Identifier: MIT
//! Makes the messages from the schema that the server and all other clients use.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::var("WARPFACTOR_PROTOCOL").unwrap_or_else(|_| "../../../protocol".into());
    println!("cargo:rerun-if-env-changed=WARPFACTOR_PROTOCOL");
    println!("cargo:rerun-if-changed={folder}/messages.proto");
    let files = protox::compile(["messages.proto"], [&folder])?;
    prost_build::Config::new().compile_fds(files)?;
    Ok(())
}
