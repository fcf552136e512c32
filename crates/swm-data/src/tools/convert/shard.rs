//! Conversion by several machines: each writes a shard of a Lance dataset.

use super::{ConvertOptions, Converted, Source, advance, check_distinct, start};
use crate::dataset::{Location, Reader, WriteMode, WriteOptions};
use crate::formats::lance::{Shard, create_shard};
use std::sync::Arc;
use swm_core::run::{Control, Event};
use swm_core::{Batch, Result};

/// The name of the stage.
const STAGE: &str = "convert";

/// Writes the episodes of a shard of the target, which has a consecutive part of the source's episodes. Another call continues
/// a shard that was interrupted. Nothing is compared: the shards can be read once
/// [`commit_shards`](crate::lance::commit_shards) has committed all of them.
///
/// # Errors
/// If the target is the source, the source is damaged, the shard cannot be written, or the run is stopped.
pub fn convert_shard(
    reader: &Arc<dyn Reader>,
    target: &Location,
    options: &ConvertOptions,
    shard: Shard,
    control: &mut Control<'_>,
) -> Result<Converted> {
    check_distinct(&**reader, target)?;
    let source = Source::new(&**reader);
    let episodes = shard.episodes(reader.episodes().len());
    let (codec, manifest, commit) = (options.codec, reader.manifest(), options.commit);
    let write = WriteOptions { mode: WriteMode::Append, codec, manifest, commit, exclusive: true, continues: None };
    let mut writer = create_shard(target, &source.schema, write, shard)?;
    let existing = writer.episodes().min(episodes.len());
    let mut report = Converted {
        episodes: episodes.len(),
        existing,
        rows: 0,
        last_actions: 0,
        checksum: None,
        columns: vec![],
        unread: reader.unread(),
    };
    start(control, STAGE, episodes.len());
    let mut rows = Batch::zeros(&source.schema, 0);
    let mut copy = || -> Result<()> {
        for (done, episode) in episodes.clone().enumerate().skip(existing) {
            let cut = source.read(episode, &mut rows)?;
            writer.write_episode_with(&rows, &reader.constants(episode)?)?;
            report.rows += rows.rows();
            report.last_actions += usize::from(cut);
            advance(control, STAGE, done + 1, episodes.len())?;
        }
        Ok(())
    };
    if let Err(error) = copy() {
        // Complete episodes are kept, and the shard stays unfinished.
        writer.pause()?;
        return Err(error);
    }
    writer.finish()?;
    control.emit(Event::Finished { stage: STAGE, metrics: &[] });
    Ok(report)
}
