//! CPU kernels for planning and for training image encoders, hidden layers and small networks ([`ReluNetwork`]), on plain `f32` slices.
//!
//! A tensor library allocates and reads memory once per operation. Here weights are laid out once ([`Panels`]), scratch
//! memory is reused ([`ScratchPool`]), and every row is computed independently, so no byte of a result depends on the
//! number of threads or on the other rows. The crate depends neither on tensors nor on model families: `swm-models`
//! converts its layers to [`Affine`], [`Norm`], [`Panels`], [`VitParameters`] and [`ConvParameters`].

#![allow(clippy::needless_range_loop, reason = "indexed loops over constant lane counts are vectorised")]

mod adamw;
mod affine;
mod attention;
mod blocks;
mod colour_moments;
mod conv;
mod epps_pulley;
pub mod functions;
mod keypoints;
mod matrix;
mod norm;
mod norm_mish;
mod panels;
mod product;
mod relu_network;
mod scratch;
mod vit;
mod vit_gradient;

pub use adamw::{AdamWStep, sum_of_squares};
pub use affine::Affine;
pub use attention::causal_attention;
pub use blocks::{BLOCK, write_blocks};
pub use colour_moments::{ColourMoments, ColourScratch};
pub use conv::{ChannelStatistics, ConvEncoder, ConvGradient, ConvParameters, ConvSizes, ConvStage};
pub use epps_pulley::{EppsPulley, Statistics};
pub use keypoints::{FilterBank, KeypointScratch, Keypoints};
pub use matrix::{Matrix, multiply};
pub use norm::{Modulation, Norm, add_gated};
pub use norm_mish::{NormMish, NormMishTape};
pub use panels::Panels;
pub use relu_network::{ReluLayer, ReluNetwork, ReluScratch, ReluTape};
pub use scratch::{ScratchPool, grown};
pub use vit::{VitEncoder, VitLayerParameters, VitParameters};
pub use vit_gradient::{Tape, VitGradient, VitGradientScratch, VitGradientSums};
