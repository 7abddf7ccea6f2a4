//! There are no dependency cycles between the source files of any crate. To understand a file, a
//! reader needs only the files that it depends on. And a type's name stands for one thing in its
//! crate.
//!
//! A file depends on another if it uses a name that is defined there. Names are followed through
//! imports, aliases, globs and re-exports to their definitions. A re-export (`pub use`) and the
//! declaration of a module (`mod`) do not count as uses, so that a crate's root may list its parts.
//! Unit tests are excluded. Names in macro arguments and methods are not detected: the methods of
//! one type may be divided over its file and that file's children, as those of the pipeline are.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use syn::visit::Visit;
use syn::{Attribute, Item, UseTree, Visibility};

/// A module: its definitions and imports.
#[derive(Default)]
struct Module {
    /// Its file, as a number.
    file: usize,
    /// Modules declared in it.
    children: BTreeSet<String>,
    /// Everything else that is defined in it.
    items: BTreeSet<String>,
    /// Its imports: the local name and the path as written.
    imports: BTreeMap<String, Vec<String>>,
    /// The paths of its glob imports.
    globs: Vec<Vec<String>>,
}

/// A crate's modules by their path from the root, and its files.
#[derive(Default)]
struct Sources {
    modules: BTreeMap<Vec<String>, Module>,
    files: Vec<PathBuf>,
    /// Per file, its module and the paths it uses.
    named: Vec<(usize, Vec<String>, Vec<String>)>,
}

fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute
                .parse_args::<syn::Path>()
                .is_ok_and(|path| path.is_ident("test"))
    })
}

fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(x) => &x.attrs,
        Item::Enum(x) => &x.attrs,
        Item::Fn(x) => &x.attrs,
        Item::Impl(x) => &x.attrs,
        Item::Mod(x) => &x.attrs,
        Item::Static(x) => &x.attrs,
        Item::Struct(x) => &x.attrs,
        Item::Trait(x) => &x.attrs,
        Item::Type(x) => &x.attrs,
        Item::Use(x) => &x.attrs,
        _ => &[],
    }
}

fn name(item: &Item) -> Option<String> {
    let ident = match item {
        Item::Const(x) => &x.ident,
        Item::Enum(x) => &x.ident,
        Item::Fn(x) => &x.sig.ident,
        Item::Static(x) => &x.ident,
        Item::Struct(x) => &x.ident,
        Item::Trait(x) => &x.ident,
        Item::Type(x) => &x.ident,
        Item::Union(x) => &x.ident,
        _ => return None,
    };
    Some(ident.to_string())
}

/// The leaves of an import: the local name of each (`*` for a glob) and its path.
fn leaves(tree: &UseTree, before: &[String], found: &mut Vec<(String, Vec<String>)>) {
    let with = |ident: &syn::Ident| [before, &[ident.to_string()]].concat();
    match tree {
        UseTree::Path(path) => leaves(&path.tree, &with(&path.ident), found),
        UseTree::Name(name) if name.ident == "self" => {
            found.push((before.last().cloned().unwrap_or_default(), before.to_vec()));
        }
        UseTree::Name(name) => found.push((name.ident.to_string(), with(&name.ident))),
        UseTree::Rename(rename) if rename.ident == "self" => {
            found.push((rename.rename.to_string(), before.to_vec()));
        }
        UseTree::Rename(rename) => found.push((rename.rename.to_string(), with(&rename.ident))),
        UseTree::Glob(_) => found.push(("*".to_owned(), before.to_vec())),
        UseTree::Group(group) => group
            .items
            .iter()
            .for_each(|tree| leaves(tree, before, found)),
    }
}

/// Collects the paths that code uses.
#[derive(Default)]
struct Paths(Vec<Vec<String>>);

impl<'a> Visit<'a> for Paths {
    fn visit_path(&mut self, path: &'a syn::Path) {
        self.0
            .push(path.segments.iter().map(|s| s.ident.to_string()).collect());
        syn::visit::visit_path(self, path);
    }

    fn visit_item_use(&mut self, item: &'a syn::ItemUse) {
        let mut found = Vec::new();
        leaves(&item.tree, &[], &mut found);
        self.0.extend(found.into_iter().map(|(_, path)| path));
    }

    fn visit_item_mod(&mut self, _: &'a syn::ItemMod) {}

    /// `pub(crate)` names nothing.
    fn visit_visibility(&mut self, _: &'a Visibility) {}
}

impl Sources {
    /// A crate, from its first file on.
    fn read(root: &Path) -> Self {
        let mut sources = Self::default();
        let folder = root.parent().expect("a folder").to_owned();
        sources.file(root, &folder, Vec::new());
        sources
    }

    /// A file whose modules lie in `folder`.
    fn file(&mut self, file: &Path, folder: &Path, module: Vec<String>) {
        let text =
            std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let parsed = syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        self.files.push(file.to_owned());
        self.items(self.files.len() - 1, &parsed.items, folder, module);
    }

    fn items(&mut self, file: usize, items: &[Item], folder: &Path, module: Vec<String>) {
        let mut this = Module {
            file,
            ..Module::default()
        };
        for item in items.iter().filter(|item| !is_test(attributes(item))) {
            this.items.extend(name(item));
            match item {
                Item::Mod(child) => {
                    let name = child.ident.to_string();
                    let path = [&module[..], std::slice::from_ref(&name)].concat();
                    match &child.content {
                        Some((_, items)) => self.items(file, items, &folder.join(&name), path),
                        None => {
                            let beside = folder.join(format!("{name}.rs"));
                            let inside = folder.join(&name).join("mod.rs");
                            let file = if beside.exists() { beside } else { inside };
                            self.file(&file, &folder.join(&name), path);
                        }
                    }
                    this.children.insert(name);
                }
                Item::Use(import) => {
                    let mut found = Vec::new();
                    leaves(&import.tree, &[], &mut found);
                    for (name, path) in found {
                        if matches!(import.vis, Visibility::Inherited) {
                            self.named.push((file, module.clone(), path.clone()));
                        }
                        if name == "*" {
                            this.globs.push(path);
                        } else {
                            this.imports.insert(name, path);
                        }
                    }
                }
                other => {
                    let mut paths = Paths::default();
                    paths.visit_item(other);
                    let named = paths.0.into_iter().map(|path| (file, module.clone(), path));
                    self.named.extend(named);
                }
            }
        }
        self.modules.insert(module, this);
    }

    /// The file that defines `path`, seen from `module`; `None` if it is no file of this crate.
    fn defined(&self, module: &[String], path: &[String], depth: usize) -> Option<usize> {
        let (first, rest) = path.split_first()?;
        // The compiler reports circular imports.
        if depth > 20 {
            return None;
        }
        match first.as_str() {
            "crate" => return self.below(&[], rest, depth),
            "self" => return self.below(module, rest, depth),
            "super" => return self.below(module.split_last()?.1, rest, depth),
            _ => {}
        }
        self.below(module, path, depth)
    }

    fn below(&self, module: &[String], path: &[String], depth: usize) -> Option<usize> {
        let this = self.modules.get(module)?;
        let Some((first, rest)) = path.split_first() else {
            return Some(this.file);
        };
        if first == "super" {
            return self.below(module.split_last()?.1, rest, depth);
        }
        if this.children.contains(first) {
            return self.below(&[module, std::slice::from_ref(first)].concat(), rest, depth);
        }
        if this.items.contains(first) {
            return Some(this.file);
        }
        if let Some(import) = this.imports.get(first) {
            return self.defined(module, &[import, rest].concat(), depth + 1);
        }
        let through = this.globs.iter().map(|glob| [&glob[..], path].concat());
        through
            .filter_map(|path| self.defined(module, &path, depth + 1))
            .next()
    }

    /// Per file, the files that it depends on.
    fn edges(&self) -> BTreeMap<usize, BTreeSet<usize>> {
        let mut edges = BTreeMap::<usize, BTreeSet<usize>>::new();
        for (file, module, path) in &self.named {
            if let Some(other) = self.defined(module, path, 0).filter(|other| other != file) {
                edges.entry(*file).or_default().insert(other);
            }
        }
        edges
    }

    /// The files of each cycle, one cycle per line.
    fn circles(&self) -> Vec<String> {
        let edges = self.edges();
        let reach = |from: usize| {
            let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
            while let Some(next) = open.pop() {
                for other in edges.get(&next).into_iter().flatten() {
                    if seen.insert(*other) {
                        open.push(*other);
                    }
                }
            }
            seen
        };
        let reached: Vec<BTreeSet<usize>> = (0..self.files.len()).map(reach).collect();
        let mut found = BTreeSet::new();
        for file in 0..self.files.len() {
            let circle: Vec<usize> = reached[file]
                .iter()
                .copied()
                .filter(|other| reached[*other].contains(&file))
                .collect();
            if circle.len() > 1 {
                let within = |a: &usize| {
                    edges
                        .get(a)
                        .into_iter()
                        .flatten()
                        .filter(|b| circle.contains(b))
                };
                let arrows = circle.iter().flat_map(|a| within(a).map(move |b| (*a, *b)));
                let name = |file: usize| self.files[file].display().to_string();
                let arrows: Vec<String> = arrows
                    .map(|(a, b)| format!("{} -> {}", name(a), name(b)))
                    .collect();
                found.insert(arrows.join("\n"));
            }
        }
        found.into_iter().collect()
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("tests/ lies in the workspace")
        .to_owned()
}

/// The first files of all crates of the workspace: libraries and programs.
fn crates() -> Vec<PathBuf> {
    let manifest = std::fs::read_to_string(root().join("Cargo.toml")).expect("the workspace");
    let manifest: toml::Table = manifest.parse().expect("a manifest");
    let members = manifest["workspace"]["members"]
        .as_array()
        .expect("a list of members");
    // The timed program shares a file with another one, by a `path` that is not followed here.
    let folders = (members.iter().filter_map(|member| member.as_str()))
        .filter(|member| *member != "tests/peers/ours");
    let roots = folders.flat_map(|member| {
        ["src/lib.rs", "src/main.rs"].map(|file| root().join(member).join(file))
    });
    roots.filter(|file| file.exists()).collect()
}

/// The names of types that are defined in several modules. (Constants are in capitals, functions in
/// small letters.)
fn repeated(sources: &Sources) -> Vec<String> {
    let mut places = BTreeMap::<&str, Vec<String>>::new();
    for module in sources.modules.values() {
        let file = sources.files[module.file].display().to_string();
        for item in &module.items {
            if item.contains(char::is_uppercase) && item.contains(char::is_lowercase) {
                places.entry(item).or_default().push(file.clone());
            }
        }
    }
    let several = places.into_iter().filter(|(_, files)| files.len() > 1);
    several
        .map(|(name, files)| format!("{name}: {}", files.join(", ")))
        .collect()
}

#[test]
fn a_type_name_stands_for_one_thing_in_its_crate() {
    let found: Vec<String> = (crates().iter())
        .flat_map(|file| repeated(&Sources::read(file)))
        .collect();
    assert!(found.is_empty(), "{}", found.join("\n"));
    let b =
        "pub struct Node;\nconst C: u8 = 1;\nfn f() {}\n#[cfg(test)]\nmod tests { struct Case; }\n";
    let a = "enum Node {}\nconst C: u8 = 2;\nfn f() {}\n#[cfg(test)]\nmod tests { struct Case; }\n";
    let folder = written(&[("lib.rs", "mod a;\nmod b;\n"), ("a.rs", a), ("b.rs", b)]);
    let found = repeated(&Sources::read(&folder.path().join("lib.rs")));
    assert!(
        found.len() == 1 && found[0].starts_with("Node: "),
        "{found:?}"
    );
}

#[test]
fn no_file_stands_on_one_that_stands_on_it() {
    let crates = crates();
    assert!(crates.len() >= 9, "{crates:?}");
    let circles: Vec<String> = crates
        .iter()
        .flat_map(|file| Sources::read(file).circles())
        .collect();
    assert!(circles.is_empty(), "{}", circles.join("\n\n"));
}

/// A crate of these files in a new folder.
fn written(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    for (file, text) in files {
        let file = folder.path().join(file);
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("a folder");
        std::fs::write(file, text).expect("a file");
    }
    folder
}

/// The circles of a crate of these files.
fn example(files: &[(&str, &str)]) -> Vec<String> {
    let folder = written(files);
    let circles = Sources::read(&folder.path().join("lib.rs")).circles();
    let place = format!("{}/", folder.path().display());
    circles
        .into_iter()
        .map(|circle| circle.replace(&place, ""))
        .collect()
}

#[test]
fn circles_are_found_however_names_come() {
    let lib = ("lib.rs", "mod a;\nmod b;\npub use a::A;\n");
    let none: [&str; 0] = [];
    let b = ("b.rs", "pub struct B;\n");
    assert_eq!(
        example(&[lib, ("a.rs", "use crate::b::B;\npub struct A(B);\n"), b]),
        none
    );
    let circle = ["a.rs -> b.rs\nb.rs -> a.rs"];
    let a = ("a.rs", "use crate::b::B;\npub struct A(B);\n");
    for back in [
        "pub struct B;\nuse crate::a::A;\n",
        "pub struct B;\nfn f(_: super::a::A) {}\n",
        "pub struct B;\nuse crate::A;\n",
        "pub struct B;\nuse crate::a;\nfn f(_: a::A) {}\n",
        "pub struct B;\nuse crate::a::*;\nfn f(_: A) {}\n",
        "pub struct B;\nuse crate::a as other;\nfn f() { let _: Option<other::A> = None; }\n",
    ] {
        assert_eq!(example(&[lib, a, ("b.rs", back)]), circle, "{back}");
    }
    // Unit tests may depend on anything.
    let tested = (
        "b.rs",
        "pub struct B;\n#[cfg(test)]\nmod tests {\n    use crate::a::A;\n}\n",
    );
    assert_eq!(example(&[lib, a, tested]), none);
    // A part that uses its parent's definitions, and the reverse.
    let whole = ("a.rs", "mod part;\npub struct A;\nfn f() { part::g() }\n");
    let part = ("a/part.rs", "use super::A;\npub fn g() { let _ = A; }\n");
    let found = example(&[("lib.rs", "mod a;\n"), whole, part]);
    assert_eq!(found, ["a.rs -> a/part.rs\na/part.rs -> a.rs"]);
}
