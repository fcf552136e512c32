//! The keys of JSON objects in the order of the file, which parsed objects do not preserve. The reference
//! implementation applies modules in that order.

use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::ser::{Serialize, SerializeMap as _, Serializer};
use std::fmt;

/// The keys of a JSON object in the order of the file. Each key has the keys of its value.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Keys(pub Vec<(String, Keys)>);

impl Keys {
    /// The keys of the object at a dotted path.
    pub fn at(&self, path: &str) -> Option<&Self> {
        path.split('.').try_fold(self, |keys, key| keys.0.iter().find(|(name, _)| name == key).map(|(_, keys)| keys))
    }
}

impl<'de> Deserialize<'de> for Keys {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Each;
        impl<'de> Visitor<'de> for Each {
            type Value = Keys;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("JSON")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Keys, A::Error> {
                let mut keys = vec![];
                while let Some(entry) = map.next_entry()? {
                    keys.push(entry);
                }
                Ok(Keys(keys))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut all: A) -> Result<Keys, A::Error> {
                while all.next_element::<IgnoredAny>()?.is_some() {}
                Ok(Keys::default())
            }
            fn visit_bool<E>(self, _: bool) -> Result<Keys, E> {
                Ok(Keys::default())
            }
            fn visit_i64<E>(self, _: i64) -> Result<Keys, E> {
                Ok(Keys::default())
            }
            fn visit_u64<E>(self, _: u64) -> Result<Keys, E> {
                Ok(Keys::default())
            }
            fn visit_f64<E>(self, _: f64) -> Result<Keys, E> {
                Ok(Keys::default())
            }
            fn visit_str<E>(self, _: &str) -> Result<Keys, E> {
                Ok(Keys::default())
            }
            fn visit_unit<E>(self) -> Result<Keys, E> {
                Ok(Keys::default())
            }
        }
        deserializer.deserialize_any(Each)
    }
}

/// An object that is serialised with its keys in the order of the vector.
pub(crate) struct InOrder<T>(pub Vec<(String, T)>);

impl<T: Serialize> Serialize for InOrder<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (key, value) in &self.0 {
            map.serialize_entry(key, value)?;
        }
        map.end()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_keep_the_order_of_the_file() {
        let text = r#"{"z": {"second": 1, "first": [{"x": 2}], "null": null}, "a": "text"}"#;
        let keys: Keys = serde_json::from_str(text).expect("parsing the JSON");
        let names = |keys: &Keys| keys.0.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
        assert_eq!(names(&keys), ["z", "a"]);
        assert_eq!(names(keys.at("z").expect("the key z")), ["second", "first", "null"]);
        assert!(keys.at("z.third").is_none());
        let written = serde_json::to_string(&InOrder(vec![("b".to_owned(), 1), ("a".to_owned(), 2)]))
            .expect("serialising to JSON");
        assert_eq!(written, r#"{"b":1,"a":2}"#);
    }
}
