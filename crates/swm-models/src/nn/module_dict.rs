//! [`ModuleDict`]: modules under names that are known at run time only, such as the names of columns.

use burn::module::{Content, Devices, Module, ModuleDisplay, ModuleDisplayDefault, ModuleMapper, ModuleVisitor};
use burn::tensor::Device;
use std::fmt::Debug;

/// Modules under names that are known only when the model is created, in a fixed order. The path of a parameter
/// contains the name, as in PyTorch's `ModuleDict`.
#[derive(Clone, Debug)]
pub struct ModuleDict<M>(pub Vec<(String, M)>);

impl<M> ModuleDict<M> {
    /// Iterates over names and modules.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &M)> {
        self.0.iter().map(|(name, module)| (name.as_str(), module))
    }

    fn map_modules(self, change: impl Fn(M) -> M) -> Self {
        Self(self.0.into_iter().map(|(name, module)| (name, change(module))).collect())
    }
}

const CONTAINER: &str = "ModuleDict";

impl<M: Module> Module for ModuleDict<M> {
    fn collect_devices(&self, devices: Devices) -> Devices {
        self.0.iter().fold(devices, |devices, (_, module)| module.collect_devices(devices))
    }

    fn fork(self, device: &Device) -> Self {
        self.map_modules(|module| module.fork(device))
    }

    fn to_device(self, device: &Device) -> Self {
        self.map_modules(|module| module.to_device(device))
    }

    fn num_params(&self) -> usize {
        self.0.iter().map(|(_, module)| module.num_params()).sum()
    }

    fn visit<V: ModuleVisitor>(&self, visitor: &mut V) {
        for (name, module) in &self.0 {
            visitor.enter_module(name, CONTAINER);
            module.visit(visitor);
            visitor.exit_module(name, CONTAINER);
        }
    }

    fn map<P: ModuleMapper>(self, mapper: &mut P) -> Self {
        let mut map = |(name, module): (String, M)| {
            mapper.enter_module(&name, CONTAINER);
            let module = module.map(mapper);
            mapper.exit_module(&name, CONTAINER);
            (name, module)
        };
        Self(self.0.into_iter().map(&mut map).collect())
    }

    fn valid(&self) -> Self {
        Self(self.0.iter().map(|(name, module)| (name.clone(), module.valid())).collect())
    }

    fn train(self) -> Self {
        self.map_modules(Module::train)
    }

    fn materialize(self) -> Self {
        self.map_modules(Module::materialize)
    }
}

impl<M: Module + ModuleDisplay> ModuleDisplayDefault for ModuleDict<M> {
    fn content(&self, content: Content) -> Option<Content> {
        self.0.iter().fold(content, |content, (name, module)| content.add(name, module)).optional()
    }
}

impl<M: Module + ModuleDisplay> ModuleDisplay for ModuleDict<M> {}
