//! [`Affine`]: the two parameters that linear layers and layer normalisations have.

use crate::Panels;
use crate::functions::add_rows;

/// Weight and bias of a linear layer or of a layer normalisation, or the gradients of weight and bias.
#[derive(Clone, Debug, PartialEq)]
pub struct Affine {
    /// The weight: `[outputs, inputs]` of a linear layer, `[features]` of a normalisation.
    pub weight: Vec<f32>,
    /// The bias: `[outputs]` of a linear layer, `[features]` of a normalisation.
    pub bias: Vec<f32>,
}

impl Affine {
    /// Returns zeros for a linear layer with the given sizes; `inputs` is 1 for a normalisation.
    pub(crate) fn zeros(inputs: usize, outputs: usize) -> Self {
        Self { weight: vec![0.0; inputs * outputs], bias: vec![0.0; outputs] }
    }

    /// Returns weight and bias, to which the gradients of a normalisation are added.
    pub(crate) fn as_mut(&mut self) -> [&mut [f32]; 2] {
        [&mut self.weight, &mut self.bias]
    }

    /// Adds the gradients of a linear layer with inputs `x`, whose outputs have the gradient `dy`. `panels` is memory
    /// for `x` with as many columns as the layer has inputs.
    ///
    /// # Shapes
    /// `x` is `[rows, inputs]`, `dy` is `[rows, outputs]`.
    pub(crate) fn add_linear_gradient(&mut self, panels: &mut Panels, x: &[f32], dy: &[f32]) {
        let (inputs, outputs) = (panels.outputs(), self.bias.len());
        panels.fill_rows(x.len() / inputs, (x, inputs));
        panels.add_transposed(outputs, (dy, outputs), (&mut self.weight, inputs));
        add_rows(&mut self.bias, dy);
    }
}
