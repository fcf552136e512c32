//! A decoder of what a model imagines, which is fitted when the page asks for it.

use super::{PlanSession, text};
use crate::datasets::is_dataset;
use crate::plans::FrameDecoder;
use crate::plans::messages::{Named, Reply};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use swm_core::run::{Control, Event};
use swm_core::{Error, Result};
use swm_data::Reader;

/// The time between two reports of a fit.
const REPORT: Duration = Duration::from_millis(100);

/// A decoder, and what it was fitted to.
pub(super) struct Fitted {
    pub model: String,
    dataset: Named,
    /// A hash of what the dataset says of itself.
    content: String,
    pub decoder: Rc<FrameDecoder>,
}

impl PlanSession<'_> {
    /// Shows what the model imagines as frames, with a decoder that is fitted to a dataset unless it is known.
    pub(super) fn decode(&mut self, dataset: Option<Named>) -> Result<()> {
        let model = self.in_use()?.model.clone();
        match dataset {
            None => self.fitted = None,
            Some(dataset) => {
                let path = self.datasets.find(dataset.folder, &dataset.name, 1, is_dataset)?;
                let reader = swm_data::open(path)?;
                let lengths: Vec<usize> = reader.episodes().iter().map(|episode| episode.length).collect();
                let content = serde_json::to_vec(&(reader.manifest(), lengths)).unwrap_or_default();
                let content = swm_core::manifest::hash(&content);
                let is_it = |it: &Fitted| it.model == model && it.dataset == dataset && it.content == content;
                if !self.fitted.as_ref().is_some_and(is_it) {
                    self.fitted = None;
                    match self.fit(&*reader) {
                        Ok(decoder) => {
                            self.fitted = Some(Fitted { model, dataset, content, decoder: Rc::new(decoder) });
                        }
                        // The page has ended the fit.
                        Err(Error::Interrupted) => {}
                        Err(error) => return Err(error),
                    }
                }
            }
        }
        self.use_decoder();
        let explained = self.fitted.as_ref().map(|it| it.decoder.explained);
        self.out.send(text(&Reply::Decodes { explained }));
        self.show_frames()
    }

    /// Gives the decoder, if it is one of the model that plans, to that model.
    pub(super) fn use_decoder(&mut self) {
        let Some(in_use) = &mut self.in_use else { return };
        if self.fitted.as_ref().is_some_and(|it| it.model != in_use.model) {
            self.fitted = None;
        }
        if let Some(imagination) = &mut in_use.imagination {
            imagination.decoder = self.fitted.as_ref().map(|it| Rc::clone(&it.decoder));
        }
    }

    fn fit(&mut self, reader: &dyn Reader) -> Result<FrameDecoder> {
        let out = self.out.clone();
        out.enough.store(false, Ordering::Relaxed);
        let Some(in_use) = &mut self.in_use else { return Err(Error::Interrupted) };
        let Some(imagination) = &mut in_use.imagination else {
            let problem = "its latents are not those of frames alone";
            return Err(Error::config(&in_use.model, problem, "choose a model whose only input is the frame"));
        };
        let mut reported: Option<Instant> = None;
        let mut control = Control::new()
            .with_interrupt(Arc::clone(&out.gone))
            .with_poll(|| if out.enough.load(Ordering::Relaxed) { Err(Error::Interrupted) } else { Ok(()) })
            .with_events(|event| {
                if let Event::Progress(progress) = event
                    && reported.is_none_or(|at| at.elapsed() > REPORT)
                {
                    reported = Some(Instant::now());
                    out.reply(&Reply::Fitting { done: progress.done, total: progress.total });
                }
            });
        self.planners.decoder(imagination.model(), reader, &mut control)
    }

    /// Adds the frames to the plan that is shown, if it is the one of the last search.
    fn show_frames(&mut self) -> Result<()> {
        let Some(imagination) = self.in_use.as_ref().and_then(|in_use| in_use.imagination.as_ref()) else {
            return Ok(());
        };
        if self.searched_at != Some(self.tree.node().id) {
            return Ok(());
        }
        let Some(Ok(mut plan)) = self.tree.plan().map(serde_json::from_str::<serde_json::Value>) else {
            return Ok(());
        };
        if plan["imagination"].is_object() {
            plan["imagination"]["frames"] = imagination.decoded()?;
            let plan = plan.to_string();
            self.tree.set_plan(&plan, self.tree.node().cost);
            self.send_plan(&plan);
        }
        Ok(())
    }
}
