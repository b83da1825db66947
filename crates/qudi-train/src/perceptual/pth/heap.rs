//! What a pickle builds. Values refer to each other by number, so that no depth of nesting needs a deep call,
//! not even to forget them.

/// Why a pickle is refused, in words.
pub(super) type Refusal = String;

/// A value on the machine's stack.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Value {
    /// `None`, and whatever a state dictionary holds besides its tensors.
    Nothing,
    /// A truth value or a whole number.
    Number(i64),
    /// Place in [`Heap::texts`].
    Text(usize),
    /// A class or function by its name, place in [`Heap::texts`].
    Name(usize),
    /// Place in [`Heap::lists`]: a list, a tuple, or a dictionary; see [`Heap::entries`].
    List(usize),
    /// Place in [`Heap::storages`].
    Storage(usize),
    /// Place in [`Heap::tensors`].
    Tensor(usize),
}

/// Numbers that lie outside the pickle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Storage {
    /// Name of the class, as `torch FloatStorage`; place in [`Heap::texts`].
    pub(super) kind: usize,
    /// What it is stored under; place in [`Heap::texts`].
    pub(super) key: usize,
    /// How many numbers.
    pub(super) count: usize,
}

/// A view of a storage.
#[derive(Clone, Debug)]
pub(super) struct View {
    /// Place in [`Heap::storages`].
    pub(super) storage: usize,
    /// Numbers before the first.
    pub(super) offset: usize,
    /// Sizes.
    pub(super) shape: Vec<usize>,
    /// Steps, in numbers, of every size.
    pub(super) strides: Vec<usize>,
}

/// What the values refer to.
#[derive(Debug, Default)]
pub(super) struct Heap {
    pub(super) texts: Vec<String>,
    pub(super) lists: Vec<Vec<Value>>,
    pub(super) storages: Vec<Storage>,
    pub(super) tensors: Vec<View>,
}

impl Heap {
    /// The items of a list.
    pub(super) fn items(&self, value: Value) -> Result<&[Value], Refusal> {
        match value {
            Value::List(place) => Ok(&self.lists[place]),
            _ => Err("something else where a list should be".into()),
        }
    }

    /// Keys and values of a dictionary: its list holds pairs, or keys and values in turn.
    pub(super) fn entries(&self, value: Value) -> Result<Vec<(&str, Value)>, Refusal> {
        let mut items = self.items(value)?.iter();
        let mut entries = Vec::new();
        while let Some(&item) = items.next() {
            let (key, value) = match item {
                Value::List(place) => match self.lists[place][..] {
                    [key, value] => (key, value),
                    _ => return Err("an entry that is no pair".into()),
                },
                key => (key, *items.next().ok_or("a key without a value")?),
            };
            // Other keys than texts name no tensors.
            if let Value::Text(key) = key {
                entries.push((self.texts[key].as_str(), value));
            }
        }
        Ok(entries)
    }

    /// A list of sizes.
    pub(super) fn wholes(&self, value: Value) -> Result<Vec<usize>, Refusal> {
        let items = self.items(value)?;
        if items.len() > 8 {
            return Err(format!("a tensor of {} dimensions", items.len()));
        }
        items.iter().map(|&item| whole(item)).collect()
    }
}

/// A size.
pub(super) fn whole(value: Value) -> Result<usize, Refusal> {
    match value {
        Value::Number(number) => {
            usize::try_from(number).map_err(|_| format!("{number} where a size should be"))
        }
        _ => Err("something else where a size should be".into()),
    }
}
