//! Datasets and checkpoints of the hub: pulled, read wherever a path goes, and pushed.

use crate::hub_server::{HubServer, Repository, TOKEN, hash};
use crate::{Swm, text};
use std::path::{Path, PathBuf};
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

    /// A repository of models in the cache, which has a folder for this hub.
    fn cached(&self, name: &str) -> PathBuf {
        let mut hubs = std::fs::read_dir(self.swm.path("hub")).expect("the cache");
        hubs.next().expect("a hub").expect("a folder").path().join(format!("models--lab--{name}"))
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
    setup.hub.state().down = true;
    let output = setup.run(&["pull", "hf://lab/rooms/README.md", "--json"], None);
    assert!(output.status.success() && text(&output.stdout).contains(&later), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("downloaded before"), "{}", text(&output.stderr));
    setup.json(&["pull", &format!("hf://lab/rooms@{commit}/README.md")], None);
    setup.hub.state().down = false;

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
fn changed_files_of_the_cache_are_downloaded_again() {
    let setup = Setup::new();
    let large = content(5000);
    // The last one has a folder of the name that the file of the user would get.
    let files = [("large", &large[..]), ("small", b"hello"), ("none", b"hello"), ("small.changed/x", b"whole")];
    let commit = setup.hub.commit("models/lab/rooms", &files);
    setup.hub.state().git_ids = [("small".to_owned(), "b6fc4c620b67d95f953a5c1c1230aaab5db5a1b0".to_owned())].into();
    let downloaded = || setup.json(&["pull", "hf://lab/rooms"], None)["downloaded"].as_u64();
    assert_eq!(downloaded(), Some(5015));
    let repository = setup.cached("rooms");
    let snapshot = repository.join("snapshots").join(&commit);
    let record = repository.join("verified").join(format!("{commit}.json"));
    let mut changed = large.clone();
    changed[2500] ^= 0x10;
    let change = || {
        for (name, bytes) in [("large", &changed[..]), ("small", b"hullo")] {
            // A file system may give the time of its last tick.
            let path = snapshot.join(name);
            std::fs::write(&path, bytes).expect("writing a file");
            let later = std::time::SystemTime::now() + std::time::Duration::from_secs(10);
            std::fs::File::options()
                .append(true)
                .open(&path)
                .and_then(|file| file.set_modified(later))
                .expect("a time");
        }
    };
    change();
    let output = setup.run(&["pull", "hf://lab/rooms", "--json"], None);
    let said = text(&output.stderr);
    let pulled: serde_json::Value = serde_json::from_slice(&output.stdout).expect("a document");
    assert_eq!(pulled["downloaded"], 5005, "{said}");
    assert!(said.contains("and the hub says") && said.contains("downloading it again"), "{said}");
    assert!(said.contains("large.changed is the file that the download replaces"), "{said}");
    assert_eq!(std::fs::read(snapshot.join("large.changed")).expect("the user's file"), changed);
    assert_eq!(std::fs::read(snapshot.join("large")).expect("the file"), large);
    for (name, bytes) in [("small", b"hello"), ("small.changed/x", b"whole"), ("small.changed-2", b"hullo")] {
        assert_eq!(std::fs::read(snapshot.join(name)).expect("the file"), bytes, "{name}");
    }
    assert_eq!(downloaded(), Some(0));
    // A cache of an earlier build has no record, and is compared once.
    change();
    std::fs::remove_file(&record).expect("the record");
    assert_eq!(downloaded(), Some(5005));
    std::fs::remove_file(&record).expect("the record");
    assert_eq!(downloaded(), Some(0));
    assert!(record.exists());
    // Opening compares as well.
    change();
    setup.run(&["inspect", "hf://models/lab/rooms/large"], None);
    setup.run(&["doctor", "hf://models/lab/rooms/small"], None);
    assert_eq!(std::fs::read(snapshot.join("large")).expect("the file"), large);
    assert_eq!(std::fs::read(snapshot.join("small")).expect("the file"), b"hello");
    // Without a connection, the file of the user stays where it is.
    change();
    setup.hub.state().down = true;
    let name = snapshot.join("large");
    let parts = [name.to_str().expect("a name"), "it differs from the hub's file", "large.changed"];
    setup.fails(&["pull", "hf://lab/rooms"], None, &parts);
    assert_eq!(std::fs::read(&name).expect("the user's file"), changed);
    // A cache whose record cannot be written is compared by sizes.
    std::fs::remove_dir_all(repository.join("verified")).expect("removing the record");
    std::fs::write(repository.join("verified"), "not a folder").expect("a file");
    let output = setup.run(&["pull", "hf://lab/rooms", "--json"], None);
    assert!(output.status.success() && text(&output.stderr).contains("compared by their size only"));
}

#[test]
fn a_cache_that_another_process_downloads_into_is_read_if_it_has_the_files() {
    let setup = Setup::new();
    setup.hub.commit("models/lab/rooms", &[("a.bin", &content(5000)), ("b.bin", &content(6000))]);
    setup.json(&["pull", "hf://lab/rooms/a.bin"], None);
    let lock = swm_core::files::Lock::folder(&setup.cached("rooms")).expect("the lock");
    assert_eq!(setup.json(&["pull", "hf://lab/rooms/a.bin"], None)["downloaded"], 0);
    setup.fails(&["pull", "hf://lab/rooms/b.bin"], None, &["another process writes to it"]);
    drop(lock);
    assert_eq!(setup.json(&["pull", "hf://lab/rooms/b.bin"], None)["downloaded"], 6000);
}

#[test]
fn the_cache_of_an_earlier_build_is_read_if_this_hub_lists_its_files() {
    let setup = Setup::new();
    let large = content(5000);
    let commit = setup.hub.commit("models/lab/rooms", &[("large", &large)]);
    let pull = ["pull", "hf://lab/rooms"];
    setup.json(&pull, None);
    let (own, old) = (setup.cached("rooms"), setup.swm.path("hub/models--lab--rooms"));
    std::fs::rename(&own, &old).expect("a cache as earlier builds made it");
    // It may have the files of another hub.
    setup.hub.state().down = true;
    let output = setup.run(&pull, None);
    assert!(!output.status.success() && !text(&output.stderr).contains("downloaded before"));
    setup.hub.state().down = false;
    let output = setup.run(&["pull", "hf://lab/rooms", "--json"], None);
    let pulled: serde_json::Value = serde_json::from_slice(&output.stdout).expect("a document");
    assert_eq!(pulled["downloaded"], 0);
    assert!(Path::new(pulled["path"].as_str().expect("a path")).starts_with(&old), "{pulled}");
    let said = text(&output.stderr);
    assert!(said.contains(old.to_str().expect("a name")) && said.contains("using them"), "{said}");
    setup.hub.state().down = true;
    assert!(text(&setup.run(&pull, None).stderr).contains("downloaded before"));
    setup.hub.state().down = false;
    // Other files are neither used nor replaced.
    let path = old.join("snapshots").join(commit).join("large");
    std::fs::write(&path, content(5001)).expect("a file");
    let pulled = setup.json(&pull, None);
    assert_eq!(pulled["downloaded"], 5000);
    assert!(Path::new(pulled["path"].as_str().expect("a path")).starts_with(&own), "{pulled}");
    assert_eq!(std::fs::read(path).expect("the file"), content(5001));
}

#[test]
fn commands_that_read_the_cache_without_a_connection_say_so() {
    let setup = Setup::new();
    setup.hub.commit("datasets/lab/rooms", &[("README.md", b"hello")]);
    setup.json(&["pull", "hf://datasets/lab/rooms"], None);
    setup.hub.state().down = true;
    for command in ["inspect", "doctor"] {
        let said = text(&setup.run(&[command, "hf://datasets/lab/rooms/README.md"], None).stderr);
        assert!(said.contains("downloaded before"), "{command}: {said}");
    }
    // The files of one hub are not those of another.
    let mut other = setup.swm.command(&["pull", "hf://datasets/lab/rooms"]);
    let output = other.env("HF_ENDPOINT", "http://127.0.0.1:9").output().expect("swm starts");
    assert!(!output.status.success() && !text(&output.stderr).contains("downloaded before"));
}

#[test]
fn an_emptied_list_of_files_is_asked_for_again() {
    let setup = Setup::new();
    let commit = setup.hub.commit("models/lab/rooms", &[("a", b"a")]);
    setup.json(&["pull", "hf://lab/rooms"], None);
    std::fs::write(setup.cached("rooms").join("lists").join(format!("{commit}.json")), "[]").expect("a list");
    assert_eq!(setup.json(&["pull", "hf://lab/rooms"], None)["files"], 1);
    setup.hub.commit("models/lab/none", &[]);
    setup.fails(&["pull", "hf://lab/none"], None, &["has no files"]);
}

#[test]
fn files_of_other_sizes_than_listed_end_the_download() {
    let setup = Setup::new();
    setup.hub.commit("models/lab/rooms", &[("short", b"0123456789"), ("long", b"0123456789"), ("empty", b"0")]);
    setup.hub.state().listed = [("short".to_owned(), 20), ("long".to_owned(), 5), ("empty".to_owned(), 0)].into();
    let kept = || -> u64 {
        let files = std::fs::read_dir(setup.cached("rooms").join("partial")).expect("a folder");
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
        let repository = setup.cached(name);
        assert!(repository.exists() && !repository.join("snapshots").exists());
    }
    // A folder without that name is a repository of Git as well.
    setup.hub.commit(
        "models/lab/bare",
        &[("HEAD", b"ref: x"), ("config", b"[core]"), ("objects/x", b"x"), ("refs/x", b"x")],
    );
    setup.fails(&["pull", "hf://lab/bare"], None, &["a repository of Git", "HEAD"]);
    assert!(setup.cached("bare").exists() && !setup.cached("bare").join("snapshots").exists());
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
