// SPDX-License-Identifier: MIT
//! Grabs an object of a running sim-server at its tip, moves the grab, prints what the hand feels, and lets go.

use prost::Message;
use rand::RngCore;
use sha2::{Digest, Sha256};
use std::time::{Duration, Instant};
use zenoh::handlers::RingChannel;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Config, Session, Wait};

/// Made by build.rs from protocol/messages.proto.
#[allow(dead_code)]
mod pb {
    include!(concat!(env!("OUT_DIR"), "/warpfactor.rs"));
}

type Result<T> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

const USAGE: &str = "usage: warpfactor-client OBJECT [DX DY DZ [SECONDS]]
grabs OBJECT at its tip and moves the grab by this vector [m] (0 0.5 0) in that time [s of wall clock] (2)
WARPFACTOR_CONNECT=tcp/HOST:PORT says where the server is, by default tcp/127.0.0.1:7447";
const PROTOCOL: u32 = 2; // version of the wire, in each header
const SERVER: &str = "sim"; // its name in all keys
const TIMEOUT: Duration = Duration::from_secs(5); // of connecting and of each answer
const PERIOD: Duration = Duration::from_millis(10); // of moves

fn key(channel: &str) -> String {
    format!("warpfactor/{SERVER}/{channel}")
}

/// A connection to one run of a server, its incarnation. `id` is a digest of `secret`, which each command has beside
/// it, so that nobody else can move what this client holds.
struct Client {
    session: Session,
    incarnation: u64,
    id: String,
    secret: Vec<u8>,
    sent: u64,
}

impl Client {
    fn connect(endpoint: &str) -> Result<Client> {
        let mut config = Config::default();
        config.insert_json5("mode", "\"client\"")?;
        config.insert_json5("connect/endpoints", &format!("[{endpoint:?}]"))?;
        config.insert_json5("connect/timeout_ms", &TIMEOUT.as_millis().to_string())?;
        config.insert_json5("scouting/multicast/enabled", "false")?;
        let session = zenoh::open(config).wait()?;
        let mut secret = vec![0; 16];
        rand::thread_rng().fill_bytes(&mut secret);
        let digest: String = Sha256::digest(&secret).iter().map(|byte| format!("{byte:02x}")).collect();
        let incarnation = incarnation(&session)?;
        Ok(Client { session, incarnation, id: format!("client-{}", &digest[..24]), secret, sent: 0 })
    }

    /// Sends a command about an interaction; returns the interaction as the server took it.
    fn command(&mut self, verb: &str, interaction: pb::Interaction) -> Result<pb::Interaction> {
        self.sent += 1;
        let command = pb::Command {
            header: Some(pb::Header { protocol: PROTOCOL, sequence: self.sent, ..Default::default() }),
            client: self.id.clone(),
            secret: self.secret.clone(),
            verb: verb.into(),
            interaction: Some(interaction),
            ..Default::default()
        };
        let replies = self
            .session
            .get(key(&format!("command/{verb}/{}", self.id)))
            .payload(command.encode_to_vec())
            .target(QueryTarget::All)
            .consolidation(ConsolidationMode::None) // each reply at once, not when all who listen have answered
            .timeout(TIMEOUT)
            .wait()?;
        while let Ok(reply) = replies.recv() {
            let Ok(sample) = reply.result() else { continue };
            let Ok(found) = pb::Reply::decode(&*sample.payload().to_bytes()) else { continue };
            if self.is_from_server(&found.header) {
                let refused = !found.error.is_empty();
                let taken = found.interaction.unwrap_or_default();
                return if refused { Err(format!("{verb}: {}", found.error).into()) } else { Ok(taken) };
            }
        }
        Err(format!("{verb}: no answer").into())
    }

    /// Anybody on the network may send under the keys of a server; what has its incarnation counts.
    fn is_from_server(&self, header: &Option<pb::Header>) -> bool {
        header.as_ref().is_some_and(|h| h.protocol == PROTOCOL && h.incarnation == self.incarnation)
    }
}

/// Reads the incarnation from the liveliness token of the server.
fn incarnation(session: &Session) -> Result<u64> {
    let tokens = session.liveliness().get(key("alive/server/*")).timeout(TIMEOUT).wait()?;
    let found: Vec<u64> = tokens
        .iter()
        .filter_map(|token| token.into_result().ok())
        .filter_map(|token| u64::from_str_radix(token.key_expr().as_str().rsplit('/').next()?, 16).ok())
        .collect();
    match found[..] {
        [one] => Ok(one),
        _ => Err(format!("{} servers are named {SERVER:?}; one must be", found.len()).into()),
    }
}

fn run(object: &str, by: [f64; 3], seconds: f64) -> Result<()> {
    let endpoint = std::env::var("WARPFACTOR_CONNECT").unwrap_or("tcp/127.0.0.1:7447".into());
    let mut client = Client::connect(&endpoint)?;
    // A grab lasts as long as this token, so a client that dies lets go.
    let _alive = client.session.liveliness().declare_token(key(&format!("alive/client/{}", client.id))).wait()?;
    let forces = client.session.declare_subscriber(key("reactions")).with(RingChannel::new(256)).wait()?;

    let wanted = pb::Interaction {
        object: object.into(),
        kind: "grab".into(),
        at: "tip".into(),
        stiffness: 1e4, // N/m
        max_force: 1e4, // N
        ..Default::default()
    };
    let grab = client.command("grab", wanted)?;
    let from = grab.point.unwrap_or_default();
    let held = pb::Interaction { id: grab.id, object: object.into(), kind: "grab".into(), ..Default::default() };
    println!("grabbed {object} at {:.4} {:.4} {:.4} m", from.x, from.y, from.z);

    let begin = Instant::now();
    let mut part = 0.0;
    while part < 1.0 {
        part = (begin.elapsed().as_secs_f64() / seconds).min(1.0);
        let target = pb::Vector { x: from.x + part * by[0], y: from.y + part * by[1], z: from.z + part * by[2] };
        client.command("move", pb::Interaction { target: Some(target), ..held.clone() })?;
        while let Ok(Some(sample)) = forces.try_recv() {
            let Ok(batch) = pb::Steps::decode(&*sample.payload().to_bytes()) else { continue };
            for step in batch.steps.iter().filter(|_| client.is_from_server(&batch.header)) {
                let Some(felt) = step.reactions.iter().find(|r| r.on == Some(pb::reaction::On::Grab(grab.id))) else {
                    continue;
                };
                let (f, p) = (felt.force.unwrap_or_default(), felt.point.unwrap_or_default());
                println!(
                    "step {} force {:.6e} {:.6e} {:.6e} N at {:.6} {:.6} {:.6} m",
                    step.step, f.x, f.y, f.z, p.x, p.y, p.z
                );
            }
        }
        std::thread::sleep(PERIOD);
    }
    client.command("release", held)?;
    println!("released");
    Ok(())
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let numbers: Option<Vec<f64>> = words.iter().skip(1).map(|word| word.parse().ok()).collect();
    let done = match (words.first(), numbers.as_deref()) {
        (Some(object), Some([])) if !object.starts_with('-') => run(object, [0.0, 0.5, 0.0], 2.0),
        (Some(object), Some(&[x, y, z])) => run(object, [x, y, z], 2.0),
        (Some(object), Some(&[x, y, z, seconds])) if seconds > 0.0 => run(object, [x, y, z], seconds),
        _ => {
            eprintln!("{USAGE}");
            std::process::exit(2);
        }
    };
    if let Err(error) = done {
        eprintln!("warpfactor-client: {error}");
        std::process::exit(1);
    }
}
