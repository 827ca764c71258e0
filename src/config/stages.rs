//! `[stage.NAME]` to [`StageNode`].

use super::keys::{self, OPS, Section};
use super::section::{Reader, error};
use super::tree::{Node, Value, find};
use super::{
    AoRegion, Length, Modulation, Names, ObscuranceOp, Op, Ref, StageNode, Where, WhereRule, op_channels, read, suggest,
};
use crate::Result;
use crate::grid::Border;
use crate::stage::{CombineKind, DirectionSet, DirectionWeights, GradientWeight, Method, Rho, Ties, WindowMode};

/// Reads one stage.
pub fn read(name: &str, node: &Node, names: &Names) -> Result<StageNode> {
    let key = format!("stage.{name}");
    let op = op_word(&key, node)?;
    let r = Reader::new(Section::Stage, key, op, node)?;
    Ok(StageNode {
        name: name.to_string(),
        op: read_op(&r, names)?,
        border: border(&r)?,
        where_: r.node("where").map(|node| read_where(&r, node, names)).transpose()?,
        fill: if takes(&r, "fill") { r.opt_number("fill")? } else { None },
        place: r.place,
    })
}

/// The value of `op`, which decides the other keys.
fn op_word<'a>(key: &str, node: &'a Node) -> Result<&'a str> {
    let Value::Table(table) = &node.value else {
        return Err(error(key, node.line, format!("got {node}; expected a table of keys")));
    };
    let dotted = format!("{key}.op");
    let expected = super::kinds::one_of(&OPS);
    match find(table, "op") {
        None => Err(error(&dotted, node.line, format!("missing; expected {expected}"))),
        Some(Node { value: Value::Text(op), .. }) if OPS.contains(&op.as_str()) => Ok(op),
        Some(given) => {
            let hint = match &given.value {
                Value::Text(op) => suggest::hint(op, OPS),
                _ => String::new(),
            };
            Err(error(&dotted, given.line.or(node.line), format!("got {given}{hint}; expected {expected}")))
        }
    }
}

/// Whether the stage's `op` has a key.
fn takes(r: &Reader, key: &str) -> bool {
    keys::of(Section::Stage, r.op).any(|k| k.name == key)
}

fn border(r: &Reader) -> Result<Border> {
    match r.op {
        _ if !takes(r, "border") => Ok(Border::Clip),
        // Their rule is part of the formula; the key may only repeat it.
        "occlusion_map" => r.choice("border", &[("clip", Border::Clip)]),
        "gradient" | "saliency" => r.choice("border", &[("nearest", Border::Nearest)]),
        _ => r.get("border", read::border),
    }
}

fn read_op(r: &Reader, names: &Names) -> Result<Op> {
    let reference = |key: &str| r.get(key, |n| names.resolve(read::non_empty(n)?));
    Ok(match r.op {
        "box" => Op::Box { input: reference("input")?, radius: r.get("radius", read::radius)? },
        "gaussian" => Op::Gaussian { input: reference("input")?, sigma: r.get("sigma", read::sigma)? },
        "occlusion_map" => Op::OcclusionMap { input: reference("input")?, start_level: r.int("start_level")? as usize },
        "ambient_occlusion" => ambient_occlusion(r, reference("input")?)?,
        "obscurance" => Op::Obscurance(obscurance(r, reference("input")?, names)?),
        "transfer" => Op::Transfer { input: reference("input")?, points: r.get("points", read::points)? },
        "window" => window(r, reference("input")?)?,
        "opacity_modulation" => {
            let by = reference("by")?;
            let rule = modulation(r, &by, names)?;
            Op::OpacityModulation { input: reference("input")?, by, rule }
        }
        "gradient" => {
            let (size, weight) = regression(r)?;
            Op::Gradient { input: reference("input")?, size, weight }
        }
        "saliency" => {
            let (size, weight) = regression(r)?;
            let scale_max = r.choice("scale", &[("none", false), ("max", true)])?;
            Op::Saliency { input: reference("input")?, size, weight, scale_max }
        }
        "ambient_light" => {
            let rgb = r.get("rgb", |n| colour_ref(n, names))?;
            Op::AmbientLight { input: reference("input")?, rgb, k: r.number("k")? }
        }
        "combine" => combine(r, names)?,
        other => return Err(r.error("op", format!("no stage is called {other:?}"))),
    })
}

fn solid_low(r: &Reader) -> Result<bool> {
    r.choice("solid", &[("high", false), ("low", true)])
}

/// Values of `method`.
const METHODS: [(&str, Method); 8] = [
    ("exact", Method::Exact),
    ("cdf_power", Method::CdfPower),
    ("gaussian_cdf", Method::GaussianCdf),
    ("chebyshev", Method::Chebyshev),
    ("chebyshev_literal", Method::ChebyshevLiteral),
    ("beta", Method::Beta),
    ("moments4", Method::Moments4),
    ("levels", Method::Levels),
];

/// A method as the config writes it.
pub fn method_word(method: Method) -> &'static str {
    METHODS.iter().find(|(_, m)| *m == method).map_or("", |(word, _)| word)
}

fn ambient_occlusion(r: &Reader, input: Ref) -> Result<Op> {
    let regions = [("box", AoRegion::Box), ("equal_volume", AoRegion::EqualVolume), ("ball", AoRegion::Ball)];
    let method = r.choice("method", &METHODS)?;
    let region = r.choice("region", &regions)?;
    if region == AoRegion::Ball && method != Method::Exact {
        return Err(r.error("region", "\"ball\" is for method \"exact\" only; expected \"box\" or \"equal_volume\""));
    }
    if r.has("level_count") && method != Method::Levels {
        return Err(r.error("level_count", "is for method \"levels\" only; leave it out, or use that method"));
    }
    let ties = r.choice("ties", &[("le", Ties::Le), ("mid", Ties::Mid)])?;
    Ok(Op::AmbientOcclusion {
        input,
        radius: r.get("radius", read::radius)?,
        method,
        ties,
        region,
        solid_low: solid_low(r)?,
        level_count: r.int("level_count")? as usize,
    })
}

fn obscurance(r: &Reader, input: Ref, names: &Names) -> Result<ObscuranceOp> {
    let sets = [("icosahedron", DirectionSet::Icosahedron), ("fibonacci", DirectionSet::Fibonacci)];
    let rhos = [("step", Rho::Step), ("linear", Rho::Linear), ("exponential", Rho::Exponential), ("sqrt", Rho::Sqrt)];
    let weights = [("uniform", DirectionWeights::Uniform), ("voronoi", DirectionWeights::Voronoi)];
    let directions = r.int("directions")? as usize;
    let set = r.choice("set", &sets)?;
    if set == DirectionSet::Icosahedron && ![12, 42, 162].contains(&directions) {
        let message = format!("got {directions}; expected 12, 42 or 162 (any count with set = \"fibonacci\")");
        return Err(r.error("directions", message));
    }
    let weights = r.choice("weights", &weights)?;
    if set == DirectionSet::Fibonacci && weights == DirectionWeights::Voronoi {
        return Err(r.error("weights", "\"voronoi\" is for set \"icosahedron\" only; expected \"uniform\""));
    }
    Ok(ObscuranceOp {
        input,
        directions,
        set,
        rho: r.choice("rho", &rhos)?,
        max_distance: r.get("max_distance", read::distance)?,
        weights,
        weight_by_normal: r.get("weight_by_normal", read::boolean)?,
        colour: r.opt("colour", |n| colour_ref(n, names))?,
        ambient: r.get("ambient", read::rgb)?,
        solid_low: solid_low(r)?,
    })
}

/// A stage whose channel `rgb` is meant; `combine` of such channels has colour in its only channel.
fn colour_ref(node: &Node, names: &Names) -> Result<Ref, read::Bad> {
    let found = names.resolve(read::non_empty(node)?)?;
    let Some(Some(op)) = names.op_of(&found.name) else {
        return Err(format!("{:?} is an input; expected a stage with channel rgb", found.name).into());
    };
    match (&found.channel, op) {
        (None, "combine") => Ok(found),
        (None, _) if op_channels(op).contains(&"rgb") => Ok(Ref { channel: Some("rgb".into()), ..found }),
        (Some(channel), _) if channel == "rgb" || op == "combine" => Ok(found),
        _ => Err(format!("stage {:?} has no colour; expected a stage with channel rgb", found.name).into()),
    }
}

fn window(r: &Reader, input: Ref) -> Result<Op> {
    let (low, high) = (r.number("low")?, r.number("high")?);
    if low > high {
        return Err(r.error("low", format!("got {low}, above high = {high}; expected low <= high")));
    }
    let mode = r.choice("mode", &[("keep", WindowMode::Keep), ("stretch", WindowMode::Stretch)])?;
    Ok(Op::Window { input, low, high, mode })
}

fn modulation(r: &Reader, by: &Ref, names: &Names) -> Result<Modulation> {
    let saliency_keys = r.has("threshold") || r.has("gain");
    if r.has("sigma_max2") && saliency_keys {
        let message = "sigma_max2 is for a variance, threshold and gain for a saliency; expected one or the other";
        return Err(r.error("sigma_max2", message));
    }
    let op = names.op_of(&by.name).flatten().unwrap_or("");
    let main = || op_channels(op).first().copied();
    let variance = by.channel.as_deref().or_else(main) == Some("variance");
    if r.has("sigma_max2") || (variance && !saliency_keys) {
        return Ok(Modulation::Variance { sigma_max2: r.number("sigma_max2")? });
    }
    Ok(Modulation::Saliency { threshold: r.number("threshold")?, gain: r.number("gain")? })
}

fn regression(r: &Reader) -> Result<(usize, GradientWeight)> {
    let size = r.get("size", |n| match read::integer(n, 3, 5)? {
        4 => Err(read::Bad::default()),
        size => Ok(size as usize),
    })?;
    let weights = [("distance", GradientWeight::Distance), ("inverse", GradientWeight::Inverse)];
    Ok((size, r.choice("weight", &weights)?))
}

fn combine(r: &Reader, names: &Names) -> Result<Op> {
    let key = match (r.has("inputs"), r.has("input")) {
        (true, true) => return Err(r.error("input", "inputs and input are both given; expected one of them")),
        (false, true) => "input",
        _ => "inputs",
    };
    let kinds = [
        ("add", CombineKind::Add),
        ("multiply", CombineKind::Multiply),
        ("min", CombineKind::Min),
        ("max", CombineKind::Max),
        ("mean", CombineKind::Mean),
    ];
    let inputs = r.get(key, |n| refs(n, names))?;
    Ok(Op::Combine { inputs, kind: r.choice("op_kind", &kinds)? })
}

/// One or several references.
pub fn refs(node: &Node, names: &Names) -> Result<Vec<Ref>, read::Bad> {
    read::texts(node)?.into_iter().map(|text| names.resolve(text)).collect()
}

fn read_where(stage: &Reader, node: &Node, names: &Names) -> Result<Where> {
    let r = Reader::new(Section::Where, format!("{}.where", stage.place.key), "", node)?;
    // An inline table stands on the line of `where` unless it says otherwise.
    let input = r.get("input", |n| names.resolve(read::non_empty(n)?))?;
    let (min, max) = (r.opt_number("min")?, r.opt_number("max")?);
    let rule = match r.opt("iso", read::numbers)? {
        Some(_) if min.is_some() || max.is_some() => {
            return Err(r.error("iso", "iso excludes min and max; expected one or the other"));
        }
        Some(iso) => WhereRule::Iso { iso, band: r.number("band")? },
        None if r.has("band") => return Err(r.error("band", "band is for iso; expected iso = [values] beside it")),
        None if min.is_none() && max.is_none() => {
            return Err(r.error("", "names no voxels; expected min, max or iso = [values]"));
        }
        None => WhereRule::Range { min, max },
    };
    if let (Some(min), Some(max)) = (min, max)
        && min > max
    {
        return Err(r.error("min", format!("got {min}, above max = {max}; expected min <= max")));
    }
    Ok(Where { input, rule })
}

impl Op {
    /// The value of `op`.
    pub fn word(&self) -> &'static str {
        match self {
            Op::Box { .. } => "box",
            Op::Gaussian { .. } => "gaussian",
            Op::OcclusionMap { .. } => "occlusion_map",
            Op::AmbientOcclusion { .. } => "ambient_occlusion",
            Op::Obscurance(_) => "obscurance",
            Op::Transfer { .. } => "transfer",
            Op::Window { .. } => "window",
            Op::OpacityModulation { .. } => "opacity_modulation",
            Op::Gradient { .. } => "gradient",
            Op::Saliency { .. } => "saliency",
            Op::AmbientLight { .. } => "ambient_light",
            Op::Combine { .. } => "combine",
        }
    }

    /// What the stage reads (its `where` apart), with the key that says so.
    pub fn reads(&self) -> Vec<(&'static str, &Ref)> {
        match self {
            Op::Box { input, .. }
            | Op::Gaussian { input, .. }
            | Op::OcclusionMap { input, .. }
            | Op::AmbientOcclusion { input, .. }
            | Op::Transfer { input, .. }
            | Op::Window { input, .. }
            | Op::Gradient { input, .. }
            | Op::Saliency { input, .. } => vec![("input", input)],
            Op::Obscurance(o) => {
                std::iter::once(("input", &o.input)).chain(o.colour.iter().map(|c| ("colour", c))).collect()
            }
            Op::OpacityModulation { input, by, .. } => vec![("input", input), ("by", by)],
            Op::AmbientLight { input, rgb, .. } => vec![("input", input), ("rgb", rgb)],
            Op::Combine { inputs, .. } => inputs.iter().map(|i| ("inputs", i)).collect(),
        }
    }

    /// Its reach as the config gives it.
    pub fn length(&self) -> Option<(&'static str, &Length)> {
        match self {
            Op::Box { radius, .. } | Op::AmbientOcclusion { radius, .. } => Some(("radius", radius)),
            Op::Gaussian { sigma, .. } => Some(("sigma", sigma)),
            Op::Obscurance(o) => Some(("max_distance", &o.max_distance)),
            _ => None,
        }
    }
}
