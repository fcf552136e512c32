//! Third-party assets that the environments need and this project does not ship: MuJoCo's library, and the models and
//! meshes of three Python packages.
//!
//! Each asset is a Python wheel of a pinned version and SHA-256. [`install`] downloads the wheel with `pip download`,
//! checks its hash, and unpacks the required files to `NAME-VERSION/` in [`folder`]; this folder appears only when the
//! installation is complete. It contains a list of its files with their hashes; [`verify`] compares the files with the
//! list.
//!
//! Assets are stored in `$SWM_ASSETS` if that is set, otherwise in `$STABLEWM_HOME/assets` (default
//! `~/.stable_worldmodel/assets`).

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::Command;
use swm_core::{Error, Result};

/// A Python wheel of a pinned version, and the list of its required files.
pub struct Asset {
    /// The name of the Python package, such as `mujoco`.
    pub name: &'static str,
    /// The pinned version of the package.
    pub version: &'static str,
    /// A short description of the content.
    pub summary: &'static str,
    /// The SHA-256 of the wheel by processor architecture; `any` stands for every architecture.
    wheels: &'static [(&'static str, &'static str)],
    /// The files and folders (ending in `/`) to unpack; licence files are always unpacked.
    required: &'static [&'static str],
}

/// Every asset that can be installed.
pub const ASSETS: &[Asset] = &[
    Asset {
        name: "mujoco",
        version: crate::link::VERSION,
        summary: "MuJoCo's library: the physics of every 3-D environment",
        wheels: &[
            ("x86_64", "d66928d86a2d1b601bbaa4dc11db50214d17d5301bb8afd84721313b67ff0874"),
            ("aarch64", "91a70ed9979c383ff1f5c03f25cc2e1280a8254c1a8e558d5dd7f4184f01efc9"),
        ],
        required: &["mujoco/libmujoco.so.3.17.0"],
    },
    Asset {
        name: "dm_control",
        version: "1.0.50",
        summary: "models of the DeepMind Control suite",
        wheels: &[("any", "5434e1e51ff69016867426da7df6064b18d140e4d0a628f879bbcf0e7d0a586d")],
        required: &[
            "dm_control/suite/common/",
            "dm_control/suite/acrobot.xml",
            "dm_control/suite/ball_in_cup.xml",
            "dm_control/suite/cartpole.xml",
            "dm_control/suite/cheetah.xml",
            "dm_control/suite/finger.xml",
            "dm_control/suite/hopper.xml",
            "dm_control/suite/humanoid.xml",
            "dm_control/suite/manipulator.xml",
            "dm_control/suite/pendulum.xml",
            "dm_control/suite/quadruped.xml",
            "dm_control/suite/reacher.xml",
            "dm_control/suite/walker.xml",
        ],
    },
    Asset {
        name: "ogbench",
        version: "1.2.2",
        summary: "models and meshes of OGBench: arm, gripper, tabletop, mazes",
        wheels: &[("any", "e0f809be281f2e222283283a300a5cf04fbd6947a6a7b84846fb9da2c30a088d")],
        required: &["ogbench/manipspace/descriptions/", "ogbench/locomaze/assets/"],
    },
    Asset {
        name: "gymnasium-robotics",
        version: "1.4.2",
        summary: "models and meshes of the Fetch robot",
        wheels: &[("any", "a1743530431cb377e6b3b956d284bc96436fc68bac1648ef205054c178e7dc4b")],
        required: &[
            "gymnasium_robotics/envs/assets/fetch/",
            "gymnasium_robotics/envs/assets/stls/fetch/",
            "gymnasium_robotics/envs/assets/textures/",
        ],
    },
];

/// Whether an asset is installed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// The list of the asset's files exists. [`verify`] checks the files themselves.
    Installed,
    /// The asset is not installed.
    Absent,
}

/// The name of the list of files stored with an installed asset.
const FILE_LIST: &str = "files.json";

/// The content of [`FILE_LIST`].
#[derive(Serialize, Deserialize)]
struct Files {
    /// The SHA-256 of the wheel that the files were unpacked from.
    wheel_sha256: String,
    /// The SHA-256 of each file, by path.
    files: BTreeMap<String, String>,
}

impl Asset {
    /// The folder where the asset is or would be installed.
    pub fn folder(&self) -> PathBuf {
        folder().join(format!("{}-{}", self.name, self.version))
    }

    /// Whether the asset is installed.
    pub fn status(&self) -> Status {
        if self.folder().join(FILE_LIST).is_file() { Status::Installed } else { Status::Absent }
    }

    /// Architecture and SHA-256 of the wheel for this machine.
    fn wheel(&self) -> Result<(&'static str, &'static str)> {
        let machine = std::env::consts::ARCH;
        let fits = |(arch, _): &&(&str, &str)| *arch == "any" || (*arch == machine && cfg!(target_os = "linux"));
        self.wheels.iter().find(fits).copied().ok_or_else(|| {
            let platform = format!("there is no wheel for {} on {machine}", std::env::consts::OS);
            Error::config(format!("asset {}", self.name), platform, "use Linux on x86_64 or aarch64")
        })
    }

    /// Whether a file of the wheel is unpacked: a file of `required`, or a licence.
    fn needs(&self, file: &str) -> bool {
        let licence = file.contains(".dist-info/") && file.to_ascii_uppercase().contains("LICENSE");
        licence
            || self.required.iter().any(|path| if path.ends_with('/') { file.starts_with(path) } else { file == *path })
    }

    /// An error that names the command to repair the asset.
    fn damaged(&self, path: impl Into<PathBuf>, problem: impl Into<String>) -> Error {
        Error::corrupt(path, problem, format!("run `swm assets install {}` to reinstall it", self.name))
    }
}

/// The folder of all assets: `$SWM_ASSETS`, else `$STABLEWM_HOME/assets`, else `~/.stable_worldmodel/assets`.
pub fn folder() -> PathBuf {
    swm_core::home::installed_assets()
}

/// Returns the asset with this name.
///
/// # Errors
/// When there is no asset with this name.
pub fn get(name: &str) -> Result<&'static Asset> {
    let names = ASSETS.iter().map(|asset| asset.name);
    ASSETS
        .iter()
        .find(|asset| asset.name == name)
        .ok_or_else(|| Error::unknown("asset", name, names, "`swm assets list` lists them"))
}

/// The folder of an installed asset; the paths in it are those of the wheel.
///
/// # Errors
/// When the asset is not installed; the error names the command to install it.
pub fn path(name: &str) -> Result<PathBuf> {
    let asset = get(name)?;
    match asset.status() {
        Status::Installed => Ok(asset.folder()),
        Status::Absent => Err(Error::config(
            format!("asset {name} {}", asset.version),
            format!("not installed in {}", folder().display()),
            format!("run `swm assets install {name}`"),
        )),
    }
}

/// Every asset with its status.
pub fn status() -> impl Iterator<Item = (&'static Asset, Status)> {
    ASSETS.iter().map(|asset| (asset, asset.status()))
}

/// Downloads, checks and unpacks an asset, replacing an installed one.
///
/// # Errors
/// When there is no asset with this name, or no wheel for this machine; when `pip` or the file system fails; or when
/// the hash of the wheel differs from the pinned hash.
pub fn install(name: &str) -> Result<PathBuf> {
    let asset = get(name)?;
    let (arch, sha256) = asset.wheel()?;
    let root = swm_core::home::assets()?;
    let io = |path: &Path, action: &str| {
        let (path, action) = (path.to_owned(), action.to_owned());
        move |source| Error::io(path, action, source)
    };
    // The asset is unpacked to a temporary folder and renamed when complete, so that an interrupted installation is not
    // mistaken for a complete one.
    let temporary = root.join(format!(".{name}-{}", std::process::id()));
    std::fs::create_dir_all(&temporary).map_err(io(&temporary, "creating a folder"))?;
    let unpacked =
        download(asset, arch, &temporary).and_then(|wheel| unpack(asset, &wheel, sha256, &temporary.join("complete")));
    let installed = unpacked.and_then(|()| replace(asset, &temporary));
    // The wheel, and the folders of an asset that was not unpacked completely.
    let depths: Vec<String> = (1..=16).map(|depth| format!("complete{}", "/*".repeat(depth))).collect();
    let patterns: Vec<&str> = depths.iter().map(String::as_str).chain(["*.whl"]).collect();
    swm_core::files::delete(&temporary, &patterns)?;
    if temporary.exists() {
        swm_core::files::remove_empty_folder(&temporary)?;
    }
    installed
}

/// Moves an unpacked asset from `temporary` to its folder and deletes the files of an older one. Other files in the
/// older one's folder return to the folder; a file whose name the new asset has stays in `temporary`.
fn replace(asset: &Asset, temporary: &Path) -> Result<PathBuf> {
    let (complete, target, old) = (temporary.join("complete"), asset.folder(), temporary.join("old"));
    let rename = |from: &Path, to: &Path| {
        std::fs::rename(from, to).map_err(|source| Error::io(to, format!("moving {} there", from.display()), source))
    };
    if target.exists() {
        rename(&target, &old)?;
    }
    rename(&complete, &target)?;
    let listed = std::fs::read(old.join(FILE_LIST)).ok().and_then(|text| serde_json::from_slice(&text).ok());
    let list = listed.unwrap_or(Files { wheel_sha256: String::new(), files: BTreeMap::new() });
    let patterns: Vec<&str> = list.files.keys().map(String::as_str).chain([FILE_LIST]).collect();
    for path in swm_core::files::delete(&old, &patterns)? {
        let to = target.join(path.file_name().unwrap_or_default());
        if !to.exists() {
            rename(&path, &to)?;
        }
    }
    if old.exists() {
        swm_core::files::remove_empty_folder(&old)?;
    }
    Ok(target)
}

/// Downloads the wheel of an asset to a folder.
fn download(asset: &Asset, arch: &str, into: &Path) -> Result<PathBuf> {
    let mut pip = Command::new("python3");
    // `-I` keeps modules of the current folder from replacing those of the installation.
    pip.args([
        "-I",
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--only-binary=:all:",
        "--disable-pip-version-check",
    ]);
    if arch != "any" {
        // Requests the same wheel for every installed version of Python.
        pip.args(["--python-version", "3.11", "--implementation", "cp", "--abi", "cp311"]);
        pip.args(["--platform", &format!("manylinux_2_28_{arch}")]);
    }
    let requirement = format!("{}=={}", asset.name, asset.version);
    let context = || format!("downloading {requirement} with `python3 -m pip download`");
    let output = pip.arg("--dest").arg(into).arg(&requirement).output().map_err(|error| {
        Error::external(
            context(),
            format!("{error}; Python 3 with pip must be installed (Debian: apt install python3-pip)"),
        )
    })?;
    if !output.status.success() {
        return Err(Error::external(context(), String::from_utf8_lossy(&output.stderr).trim()));
    }
    let wheel = std::fs::read_dir(into)
        .map_err(|error| Error::io(into, "reading a folder", error))?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .find(|path| path.extension().is_some_and(|extension| extension == "whl"));
    wheel.ok_or_else(|| Error::external(context(), "`pip` succeeded, but wrote no wheel"))
}

/// Checks the hash of a wheel, unpacks the required files, and writes the list of files.
fn unpack(asset: &Asset, wheel: &Path, sha256: &str, into: &Path) -> Result<()> {
    let bytes = std::fs::read(wheel).map_err(|error| Error::io(wheel, "reading a wheel", error))?;
    let found = hash(&bytes);
    if found != sha256 {
        let problem = format!("its SHA-256 is {found}, expected {sha256}");
        return Err(Error::corrupt(wheel, problem, "check the package index that `pip` uses"));
    }
    let broken = |error: zip::result::ZipError| Error::external(format!("unpacking {}", wheel.display()), error);
    let mut archive = zip::ZipArchive::new(std::io::Cursor::new(bytes)).map_err(broken)?;
    let mut files = BTreeMap::new();
    for i in 0..archive.len() {
        let mut entry = archive.by_index(i).map_err(broken)?;
        let name = entry.name().map_err(broken)?.into_owned();
        let Some(inside) = entry.enclosed_name().filter(|_| entry.is_file() && asset.needs(&name)) else { continue };
        let mut content = Vec::new();
        entry.read_to_end(&mut content).map_err(|error| Error::io(wheel, format!("unpacking {name}"), error))?;
        let target = into.join(inside);
        let parent = target.parent().unwrap_or(into);
        std::fs::create_dir_all(parent).map_err(|error| Error::io(parent, "creating a folder", error))?;
        std::fs::write(&target, &content).map_err(|error| Error::io(&target, "unpacking", error))?;
        files.insert(name, hash(&content));
    }
    let list = into.join(FILE_LIST);
    let text = serde_json::to_vec_pretty(&Files { wheel_sha256: found, files })
        .map_err(|error| Error::external("writing the list of files", error))?;
    std::fs::write(&list, text).map_err(|error| Error::io(&list, "writing", error))
}

/// Reads every file of an installed asset and compares its hash with the list.
///
/// # Errors
/// When the asset is not installed, was unpacked from another wheel, or a file is missing or differs.
pub fn verify(name: &str) -> Result<()> {
    let asset = get(name)?;
    let folder = path(name)?;
    let list = folder.join(FILE_LIST);
    let text = std::fs::read(&list).map_err(|error| Error::io(&list, "reading", error))?;
    let list: Files = serde_json::from_slice(&text).map_err(|error| asset.damaged(list, error.to_string()))?;
    if list.wheel_sha256 != asset.wheel()?.1 {
        return Err(asset.damaged(folder, "it was unpacked from another wheel"));
    }
    for (file, expected) in &list.files {
        let path = folder.join(file);
        let content = std::fs::read(&path).map_err(|_| asset.damaged(&path, "it is missing or cannot be read"))?;
        if hash(&content) != *expected {
            return Err(asset.damaged(path, "it differs from the installed file"));
        }
    }
    Ok(())
}

/// The SHA-256 of bytes, in hexadecimal.
fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
