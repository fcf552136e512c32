//! Datasets and checkpoints of the hub: pulled, read wherever a path goes, and pushed.

use crate::hub_server::{HubServer, Repository, TOKEN, hash};
use crate::{Swm, text};
use std::path::Path;
use std::process::{Output, Stdio};
use std::sync::Arc;

/// Bytes that do not repeat.
fn content(length: usize) -> Vec<u8> {
    (0..length as u64).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect()
}

/// The program with a hub on this machine.
struct Setup {
    swm: Swm,
    hub: Arc<HubServer>,
}

impl Setup {
    fn new() -> Self {
        Self { swm: Swm::new(), hub: HubServer::start() }
    }

    fn run(&self, args: &[&str], token: Option<&str>) -> Output {
        let mut command = self.swm.command(args);
        command.env("HF_ENDPOINT", &self.hub.address).env("HF_HOME", self.swm.path("hf")).env_remove("HF_TOKEN");
        command.env_remove("HF_TOKEN_PATH").envs(token.map(|token| ("HF_TOKEN", token)));
        command.output().expect("swm starts")
    }

    fn json(&self, args: &[&str], token: Option<&str>) -> serde_json::Value {
        let output = self.run(&[args, &["--json"]].concat(), token);
        assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
        serde_json::from_slice(&output.stdout).expect("a document")
    }

    fn fails(&self, args: &[&str], token: Option<&str>, parts: &[&str]) {
        let output = self.run(args, token);
        let error = text(&output.stderr);
        assert!(!output.status.success() && !error.contains("panicked"), "{args:?}: {error}");
        assert!(parts.iter().all(|part| error.contains(part)), "{args:?}: {error}");
    }
}

#[test]
fn pulls_pin_the_commit_and_continue_broken_downloads() {
    let setup = Setup::new();
    let large = content(300_000);
    let files: [(&str, &[u8]); 4] =
        [("data/a b.bin", &large), ("data/small.json", b"{}"), ("empty", b""), ("README.md", b"hello")];
    let commit = setup.hub.commit("models/lab/rooms", &files);
    setup.hub.state().break_after = Some(100_000);
    let pulled = setup.json(&["pull", "hf://lab/rooms/data"], None);
    assert_eq!(pulled["pinned"], format!("hf://lab/rooms@{commit}/data"));
    assert_eq!((pulled["files"].as_u64(), pulled["downloaded"].as_u64()), (Some(2), Some(300_002)));
    let path = Path::new(pulled["path"].as_str().expect("a path")).to_owned();
    assert!(path.starts_with(setup.swm.path("hub")));
    assert_eq!(std::fs::read(path.join("a b.bin")).expect("the file"), large);
    let ranges: Vec<String> =
        setup.hub.state().requests.iter().filter(|request| request.starts_with("storage")).cloned().collect();
    assert_eq!(ranges, ["storage GET ", "storage GET bytes=100000-"], "the second request continues the first");
    // What is cached is not downloaded again; the rest is.
    assert_eq!(setup.json(&["pull", "hf://lab/rooms"], None)["downloaded"], 5);
    assert_eq!(setup.json(&["pull", "hf://lab/rooms"], None)["downloaded"], 0);

    // A later commit moves the branch, and not a pinned URI or a tag.
    let later = setup.hub.commit("models/lab/rooms", &[("README.md", b"changed")]);
    let of = |uri: &str| {
        let pulled = setup.json(&["pull", uri], None);
        std::fs::read_to_string(pulled["path"].as_str().expect("a path")).expect("the file")
    };
    assert_eq!(of("hf://lab/rooms/README.md"), "changed");
    assert_eq!(of(&format!("hf://lab/rooms@{commit}/README.md")), "hello");
    assert_eq!(of("hf://lab/rooms@v0/README.md"), "hello");
    // Without a connection, the last commit is used; a pinned one asks nobody.
    let mut offline = setup.swm.command(&["pull", "hf://lab/rooms/README.md", "--json"]);
    let output = offline.env("HF_ENDPOINT", "http://127.0.0.1:9").output().expect("swm starts");
    assert!(output.status.success() && text(&output.stdout).contains(&later), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("downloaded before"), "{}", text(&output.stderr));

    setup.fails(&["pull", "hf://lab/rooms@v9"], None, &["no revision 'v9'"]);
    setup.fails(&["pull", "hf://lab/rooms/README.mdx"], None, &["README.mdx", "README.md"]);
    setup.fails(&["pull", "hf://lab/none"], None, &["does not exist, or is private", "HF_TOKEN"]);
    setup.fails(&["pull", "hf://lab/../rooms"], None, &["hf://lab/../rooms"]);
    setup.fails(&["pull", "hf://lab/rooms", "file"], None, &["hf://lab/rooms/file"]);
}

#[test]
fn wrong_content_is_refused_and_not_kept() {
    let setup = Setup::new();
    setup.hub.commit("models/lab/rooms", &[("a.bin", &content(5000))]);
    setup.hub.state().wrong_content = true;
    setup.fails(&["pull", "hf://lab/rooms"], None, &["SHA-256", "the hub says"]);
    setup.hub.state().wrong_content = false;
    assert_eq!(setup.json(&["pull", "hf://lab/rooms"], None)["downloaded"], 5000);
}

#[test]
fn files_of_other_sizes_than_listed_end_the_download() {
    let setup = Setup::new();
    setup.hub.commit("models/lab/rooms", &[("short", b"0123456789"), ("long", b"0123456789"), ("empty", b"0")]);
    setup.hub.state().listed = [("short".to_owned(), 20), ("long".to_owned(), 5), ("empty".to_owned(), 0)].into();
    let kept = || -> u64 {
        let files = std::fs::read_dir(setup.swm.path("hub/models--lab--rooms/partial")).expect("a folder");
        files.map(|file| file.expect("a file").metadata().expect("its size").len()).sum()
    };
    setup.fails(&["pull", "hf://lab/rooms/short"], None, &["sent 10 of 20 bytes"]);
    setup.fails(&["pull", "hf://lab/rooms/long"], None, &["more than the 5 bytes"]);
    setup.hub.state().endless = true;
    setup.fails(&["pull", "hf://lab/rooms/short"], None, &["more than the 20 bytes"]);
    setup.fails(&["pull", "hf://lab/rooms/empty"], None, &["more than the 0 bytes"]);
    assert!(kept() <= 20, "{} bytes are kept", kept());
    let requests = setup.hub.state().requests.iter().filter(|request| request.contains("/resolve/")).count();
    assert!(requests < 12, "{requests} requests");
}

#[test]
fn the_token_stays_at_the_hub_after_two_redirections() {
    let setup = Setup::new();
    setup.hub.commit("models/lab/rooms", &[("large", &content(2000))]);
    // The storage sends readers to a second address of its own, and panics if it receives a token.
    setup.hub.state().moves = true;
    assert_eq!(setup.json(&["pull", "hf://lab/rooms/large"], Some(TOKEN))["downloaded"], 2000);
    let requests = setup.hub.state().requests.iter().filter(|request| request.starts_with("storage")).count();
    assert_eq!(requests, 2);
}

#[test]
fn an_upload_ends_with_a_commit() {
    let setup = Setup::new();
    std::fs::write(setup.swm.path("file"), content(100)).expect("writing a file");
    setup.hub.state().wrong_commit = Some("main".to_owned());
    setup.fails(&["push", "./file", "hf://lab/rooms"], Some(TOKEN), &["its answer has no commit"]);
}

#[test]
fn lists_of_files_do_not_continue_at_another_host() {
    let setup = Setup::new();
    setup.hub.commit("models/lab/rooms", &[("a", b"a"), ("b", b"b"), ("c", b"c")]);
    setup.hub.state().next_host = Some("@127.0.0.1:9".to_owned());
    setup.fails(&["pull", "hf://lab/rooms"], None, &["continues at another address", "@127.0.0.1:9"]);
}

#[test]
fn settings_of_git_are_not_downloaded() {
    let setup = Setup::new();
    for (name, inner) in [("a", ".git/config"), ("b", "data/.GIT/hooks/post-checkout")] {
        setup.hub.commit(&format!("models/lab/{name}"), &[("weights", b"w"), (inner, b"[core] fsmonitor = touch x")]);
        setup.fails(&["pull", &format!("hf://lab/{name}")], None, &["no repository has", inner]);
        assert!(!setup.swm.path(&format!("hub/models--lab--{name}/snapshots")).exists());
    }
    // A folder without that name is a repository of Git as well.
    setup.hub.commit(
        "models/lab/bare",
        &[("HEAD", b"ref: x"), ("config", b"[core]"), ("objects/x", b"x"), ("refs/x", b"x")],
    );
    setup.fails(&["pull", "hf://lab/bare"], None, &["a repository of Git", "HEAD"]);
    assert!(!setup.swm.path("hub/models--lab--bare/snapshots").exists());
    setup.hub.commit("models/lab/c", &[(".gitattributes", b"*.bin filter=lfs")]);
    setup.json(&["pull", "hf://lab/c"], None);
}

#[test]
fn hashes_are_those_of_files() {
    let setup = Setup::new();
    setup.hub.commit("models/lab/rooms", &[("a", b"a"), ("large", &content(2000))]);
    for wrong in ["", "../../x", "abc"] {
        setup.hub.state().wrong_oid = Some(wrong.to_owned());
        setup.fails(&["pull", "hf://lab/rooms/large"], None, &["no SHA-256 hash"]);
    }
    setup.hub.state().wrong_oid = Some(hash(&content(2000)).to_uppercase());
    setup.json(&["pull", "hf://lab/rooms/large"], None);
}

#[test]
fn uploads_hold_no_file_in_memory() {
    let setup = Setup::new();
    let size = 256 << 20;
    let file = std::fs::File::create(setup.swm.path("large.bin")).expect("a file");
    file.set_len(size).expect("its size");
    setup.hub.state().whole = true;
    let mut command = setup.swm.command(&["push", "./large.bin", "hf://lab/large"]);
    command.env("HF_ENDPOINT", &setup.hub.address).env("HF_TOKEN", TOKEN);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("swm starts");
    setup.hub.state().uploader = Some(child.id());
    let output = child.wait_with_output().expect("swm ends");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let memory = setup.hub.state().memory;
    assert!(memory << 10 < size, "{memory} kB");
}

#[test]
fn hubs_that_ask_for_many_headers_are_refused() {
    let setup = Setup::new();
    std::fs::write(setup.swm.path("large.bin"), content(2000)).expect("a file");
    setup.hub.state().upload_headers = 40_000;
    setup.fails(&["push", "./large.bin", "hf://lab/large"], Some(TOKEN), &["40000 headers", "at most"]);
}

#[test]
fn links_that_are_not_uploaded_are_named() {
    let setup = Setup::new();
    std::fs::create_dir(setup.swm.path("files")).expect("a folder");
    std::fs::write(setup.swm.path("files/a"), b"a").expect("a file");
    std::os::unix::fs::symlink("/etc/hostname", setup.swm.path("files/link")).expect("a link");
    let output = setup.run(&["push", "./files", "hf://lab/files"], Some(TOKEN));
    let said = text(&output.stderr);
    assert!(output.status.success() && said.contains("1 links, pipes and other special files are left out"), "{said}");
    assert!(setup.hub.newest("models/lab/files").keys().all(|path| path.ends_with('a')));
}

#[test]
fn gated_and_private_repositories_ask_for_a_token() {
    let setup = Setup::new();
    for (name, gated) in [("models/lab/gated", true), ("models/lab/private", false)] {
        setup
            .hub
            .state()
            .repositories
            .insert(name.to_owned(), Repository { gated, private: !gated, ..Repository::default() });
        setup.hub.commit(name, &[("a.bin", &content(2000))]);
    }
    setup.fails(&["pull", "hf://lab/gated"], None, &["is gated", "accept them at", "/lab/gated", "HF_TOKEN"]);
    setup.fails(&["pull", "hf://lab/private"], Some("hf_wrong"), &["does not exist, or is private", "may read it"]);
    for uri in ["hf://lab/gated", "hf://lab/private"] {
        assert_eq!(setup.json(&["pull", uri], Some(TOKEN))["files"], 1);
    }
    // The file of the hub's login has the token, too.
    std::fs::create_dir_all(setup.swm.path("hf")).expect("a folder");
    std::fs::write(setup.swm.path("hf/token"), format!("{TOKEN}\n")).expect("a token");
    std::fs::remove_dir_all(setup.swm.path("hub")).expect("the cache");
    assert_eq!(setup.json(&["pull", "hf://lab/gated"], None)["files"], 1);
}

#[test]
fn a_dataset_and_a_checkpoint_go_to_the_hub_and_come_back() {
    let setup = Setup::new();
    let collect =
        ["collect", "swm/TwoRoom-v1", "--output", "rooms", "--episodes", "12", "--image", "64", "--max-steps", "30"];
    setup.json(&collect, None);
    let push = ["push", "rooms", "hf://datasets/lab/rooms", "--private"];
    setup.fails(&push, None, &["does not let you write", "HF_TOKEN"]);
    let pushed = setup.json(&push, Some(TOKEN));
    let large = pushed["uploaded"].as_u64().expect("bytes");
    assert!(large > 40_000 && pushed["bytes"].as_u64() > Some(large), "{pushed}");
    assert!(setup.hub.newest("datasets/lab/rooms").keys().all(|path| path.starts_with("rooms.lance/")));
    // The same files again are not sent.
    assert_eq!(setup.json(&push, Some(TOKEN))["uploaded"], 0);

    // A new dataset does not disappear under newer commits of an older one of the same name.
    let more = "collect swm/TwoRoom-v1 --output rooms --episodes 20 --image 64 --resume --max-steps 30";
    setup.json(&more.split(' ').collect::<Vec<_>>(), None);
    setup.json(&push, Some(TOKEN));
    std::fs::rename(setup.swm.path("datasets/rooms.lance"), setup.swm.path("datasets/kept.lance")).expect("renaming");
    setup.json(&[&collect[..], &["--seed", "9"]].concat(), None);
    setup.fails(&push, Some(TOKEN), &["has another dataset there", "'rooms.lance/_versions/", "push to another path"]);
    std::fs::remove_dir_all(setup.swm.path("datasets/rooms.lance")).expect("removing");
    std::fs::rename(setup.swm.path("datasets/kept.lance"), setup.swm.path("datasets/rooms.lance")).expect("renaming");

    let uri = "hf://datasets/lab/rooms/rooms.lance";
    let [local, remote] = ["rooms", uri].map(|name| setup.json(&["inspect", name, "--checksum"], Some(TOKEN)));
    assert_eq!(local["checksum"], remote["checksum"]);
    assert!(local["checksum"].is_string(), "{local}");

    // An evaluation records the commit.
    let capsule = concat!(env!("CARGO_MANIFEST_DIR"), "/../../zoo/two-room/pldm.safetensors");
    setup.json(&["push", capsule, "hf://lab/pldm"], Some(TOKEN));
    let eval = ["eval", "hf://lab/pldm", "--dataset", uri, "--episodes", "2", "--goal-offset", "5", "--budget", "5"];
    let quick = ["--solver", "cem,samples=4,iterations=1,elites=2", "--videos", "0", "--output", "out"];
    setup.json(&[&eval[..], &quick].concat(), Some(TOKEN));
    let results = std::fs::read_to_string(setup.swm.path("out/results.json")).expect("results");
    for name in ["hf://lab/pldm@", "hf://datasets/lab/rooms@"] {
        assert!(results.contains(name), "{name}");
    }
    assert!(std::fs::read_to_string(setup.swm.path("out/run.json")).expect("a record").contains("hf://lab/pldm@"));
    setup.fails(&["collect", "swm/TwoRoom-v1", "--output", "hf://lab/x"], None, &["swm push"]);
    // A file of a stranger opens no connection.
    let study = format!(
        "title = \"T\"\nquestion = \"q?\"\n[defaults]\nenv = \"swm/TwoRoom-v1\"\nepisodes = 1\n[[starts]]\nname = \"s\"\n\
         dataset = \"{uri}\"\n[[condition]]\nname = \"c\"\n[[policy]]\nname = \"p\"\npolicy = \"expert\"\n"
    );
    std::fs::write(setup.swm.path("study.toml"), study).expect("a study");
    setup.fails(&["study", "run", "study.toml", "--output", "s"], None, &["network connection", "--trust"]);
}

#[test]
fn pointers_of_git_are_named() {
    let swm = Swm::new();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n";
    std::fs::write(swm.path("rooms.h5"), pointer).expect("a pointer");
    swm.fails(&["inspect", "rooms.h5"], 1, &["pointer of Git LFS", "12345 bytes", "git lfs pull"]);
    std::fs::write(swm.path("model.safetensors"), pointer).expect("a pointer");
    swm.fails(&["checkpoints", "show", "./model.safetensors"], 1, &["pointer of Git LFS"]);
}
