//! The parser of `--method`.

use crate::methods::{METHODS, Method};
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

/// Returns a parser for the names of the registry, which are listed in `--help`.
pub(crate) fn methods() -> impl TypedValueParser<Value = &'static Method> {
    let value = |method: &Method| PossibleValue::new(method.name).help(method.about);
    PossibleValuesParser::new(METHODS.iter().map(value))
        .try_map(|name| Method::by_name(&name).ok_or("no method has this name"))
}
