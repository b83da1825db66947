//! Names of parameters in files, where they differ from those here.

/// Replaces parts of a name: for each pair, the first by the second.
pub fn renamed(name: &str, pairs: &[(&str, &str)]) -> String {
    pairs.iter().fold(name.to_owned(), |name, (ours, theirs)| name.replace(ours, theirs))
}

/// Doubles the number after `list` in a name: files count the activations between layers, too.
pub fn every_second(name: &str, list: &str) -> String {
    let Some((before, after)) = name.split_once(list) else { return name.to_owned() };
    let (number, rest) = after.split_once('.').unwrap_or((after, ""));
    match number.parse::<usize>() {
        Ok(number) => format!("{before}{list}{}.{rest}", 2 * number),
        Err(_) => name.to_owned(),
    }
}

/// Gives the layers of dense blocks their authors' names.
pub fn dense_blocks_renamed(name: &str) -> String {
    let mut theirs = Vec::new();
    let mut parts = name.split('.');
    while let Some(part) = parts.next() {
        match part {
            "fuse" => theirs.push("conv1x1"),
            "layers" => {
                theirs.extend(["dense_layers"].into_iter().chain(parts.next()).chain(["conv"]));
            }
            other => theirs.push(other),
        }
    }
    theirs.join(".")
}
