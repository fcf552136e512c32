//! Access to the parameters of a module by their published names.

use super::activation::has_kernels;
use burn::backend::tensor::FloatTensor;
use burn::backend::{BackendTensor, DispatchTensorKind, Flex};
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor, TensorData};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Deref;

/// A tensor on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct HostTensor {
    /// The shape.
    pub shape: Vec<usize>,
    /// The values, row-major.
    pub values: Vec<f32>,
}

/// Values by parameter name, in the order of names.
pub type Named<T> = BTreeMap<String, T>;

/// The path of the current module in a traversal.
#[derive(Default)]
struct Path(Vec<String>);

impl Path {
    fn enter(&mut self, name: &str, container: &str) {
        // The variant of an enum is not part of the name; a field `_3` is element 3 of a sequence.
        if container.starts_with("Enum:") {
            self.0.push(String::new());
        } else {
            self.0.push(name.strip_prefix('_').unwrap_or(name).to_owned());
        }
    }

    fn exit(&mut self) {
        self.0.pop();
    }

    fn name(&self) -> String {
        self.0.iter().filter(|part| !part.is_empty()).map(String::as_str).collect::<Vec<_>>().join(".")
    }
}

/// Copies every parameter and buffer of a module to the host.
pub fn values<M: Module>(module: &M) -> Named<HostTensor> {
    struct Visitor(Path, Named<HostTensor>);
    impl ModuleVisitor for Visitor {
        fn enter_module(&mut self, name: &str, container: &str) {
            self.0.enter(name, container);
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.0.exit();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let tensor = param.val().inner();
            let shape = tensor.dims().to_vec();
            let values = tensor.into_data().into_f32_vec();
            self.1.insert(self.0.name(), HostTensor { shape, values });
        }
    }
    let mut visitor = Visitor(Path::default(), Named::new());
    module.visit(&mut visitor);
    visitor.1
}

/// Returns the shape of every parameter and buffer of a module, by name.
pub fn shapes<M: Module>(module: &M) -> Named<Vec<usize>> {
    struct Visitor(Path, Named<Vec<usize>>);
    impl ModuleVisitor for Visitor {
        fn enter_module(&mut self, name: &str, container: &str) {
            self.0.enter(name, container);
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.0.exit();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            self.1.insert(self.0.name(), param.val().dims().to_vec());
        }
    }
    let mut visitor = Visitor(Path::default(), Named::new());
    module.visit(&mut visitor);
    visitor.1
}

/// Returns the gradients of a module's parameters, flattened to one axis. Omits parameters on which the loss does not
/// depend.
pub fn gradients<M: Module>(module: &M, gradients: &Gradients) -> Named<Tensor<1>> {
    struct Visitor<'a>(Path, &'a Gradients, Named<Tensor<1>>);
    impl ModuleVisitor for Visitor<'_> {
        fn enter_module(&mut self, name: &str, container: &str) {
            self.0.enter(name, container);
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.0.exit();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(gradient) = param.val().grad(self.1) {
                let count = gradient.dims().iter().product::<usize>();
                self.2.insert(self.0.name(), gradient.reshape([count]));
            }
        }
    }
    let mut visitor = Visitor(Path::default(), gradients, Named::new());
    module.visit(&mut visitor);
    visitor.2
}

/// Replaces every parameter by the result of `change(name, value)`; values are flattened to one axis.
pub fn map<M: Module>(module: M, change: impl FnMut(&str, Tensor<1>) -> Tensor<1>) -> M {
    struct Mapper<F>(Path, F);
    impl<F: FnMut(&str, Tensor<1>) -> Tensor<1>> ModuleMapper for Mapper<F> {
        fn enter_module(&mut self, name: &str, container: &str) {
            self.0.enter(name, container);
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.0.exit();
        }
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            let name = self.0.name();
            let change = &mut self.1;
            param.map(|tensor| {
                let shape = tensor.dims();
                let count = shape.iter().product::<usize>();
                change(&name, tensor.reshape([count])).reshape(shape)
            })
        }
    }
    module.map(&mut Mapper(Path::default(), change))
}

/// Replaces every parameter whose name is in `values`; the numbers of elements must agree.
pub fn load<M: Module>(module: M, values: &Named<HostTensor>) -> M {
    map(module, |name, old| match values.get(name) {
        None => old,
        Some(value) => Tensor::from_data(TensorData::new(value.values.clone(), [value.values.len()]), &old.device()),
    })
}

/// Updates an exponential moving average: every parameter and buffer becomes `keep * average + (1 - keep) * module`.
pub fn blend<M: Module>(average: M, module: &M, keep: f64) -> M {
    let mut values = Named::new();
    // Collects the tensors of the module without copying them.
    let _ = map(module.clone(), |name, value| {
        values.insert(name.to_owned(), value.clone());
        value
    });
    map(average, |name, old| match values.remove(name) {
        Some(new) if has_kernels(&old) => blend_on_host(old, &new, [keep as f32, (1.0 - keep) as f32]),
        Some(new) => old * keep + new * (1.0 - keep),
        None => old,
    })
}

/// Adds two tensors with weights, in one pass, in parts that threads compute in parallel.
fn blend_on_host(old: Tensor<1>, new: &Tensor<1>, weights: [f32; 2]) -> Tensor<1> {
    /// The elements of a part.
    const PART: usize = 1 << 16;
    let device = old.device();
    let mut values = host(old);
    let new = HostValues::of(new);
    values.par_chunks_mut(PART).zip(new.par_chunks(PART)).for_each(|(old, new)| {
        old.iter_mut().zip(new).for_each(|(old, new)| *old = *old * weights[0] + new * weights[1]);
    });
    let shape = [values.len()];
    Tensor::from_data(TensorData::new(values, shape), &device)
}

/// Adds tensors to sums, by name.
pub(crate) fn add(sums: &mut Named<Tensor<1>>, terms: Named<Tensor<1>>) {
    add_all(sums, vec![terms]);
}

/// Adds tensors to sums, by name: those of the first element of `terms` first. Names are added in parallel.
pub(crate) fn add_all(sums: &mut Named<Tensor<1>>, terms: Vec<Named<Tensor<1>>>) {
    let mut all: Named<Vec<Tensor<1>>> = Named::new();
    for (name, term) in terms.into_iter().flatten() {
        all.entry(name).or_insert_with_key(|name| sums.remove(name).into_iter().collect()).push(term);
    }
    let added = all.into_par_iter().filter_map(|(name, terms)| Some((name, terms.into_iter().reduce(|a, b| a + b)?)));
    sums.extend(added.collect::<Vec<_>>());
}

/// Returns values under the names of a module's submodule `prefix`.
pub(crate) fn prefixed<T>(prefix: &str, named: Named<T>) -> Named<T> {
    named.into_iter().map(|(name, value)| (format!("{prefix}.{name}"), value)).collect()
}

/// Counts the trained scalars of a module: the elements of parameters that need a gradient.
pub fn trained_count<M: Module>(module: &M) -> usize {
    struct Visitor(usize);
    impl ModuleVisitor for Visitor {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let value = param.val();
            if value.is_require_grad() {
                self.0 += value.dims().iter().product::<usize>();
            }
        }
    }
    let mut visitor = Visitor(0);
    // Only modules in training mark the parameters that need a gradient.
    module.clone().train().visit(&mut visitor);
    visitor.0
}

/// Copies the elements of a tensor to the host, row-major.
pub(crate) fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().into_f32_vec()
}

/// The elements of a tensor, row-major: those that the CPU holds, or a copy of those of another device.
pub(crate) enum HostValues {
    /// A contiguous tensor.
    Held(FloatTensor<Flex>),
    /// A copy.
    Copied(Vec<f32>),
}

impl HostValues {
    /// Returns the elements of a tensor outside autodiff.
    pub fn of<const D: usize>(tensor: &Tensor<D>) -> Self {
        match tensor.clone().into_dispatch().kind {
            DispatchTensorKind::Flex(BackendTensor::Float(held)) if held.as_slice::<f32>().is_some() => {
                Self::Held(held)
            }
            _ => Self::Copied(host(tensor.clone())),
        }
    }
}

impl Deref for HostValues {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match self {
            Self::Held(held) => held.as_slice().unwrap_or_default(),
            Self::Copied(values) => values,
        }
    }
}

/// Conversion of tensor data to single precision.
pub(crate) trait IntoF32 {
    /// The values, row-major.
    fn into_f32_vec(self) -> Vec<f32>;
}

impl IntoF32 for TensorData {
    fn into_f32_vec(self) -> Vec<f32> {
        self.try_into_vec_as().expect("the values of a tensor convert to single precision")
    }
}
