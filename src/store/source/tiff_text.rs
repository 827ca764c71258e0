//! What the description of a TIFF says: ImageJ's lines and OME-XML.

use std::path::Path;

use super::units;
use crate::{Error, Result};

/// Facts from the description and resolution of the first page.
#[derive(Debug, Clone, PartialEq)]
pub struct Described {
    pub order: Order,
    pub spacing: [f64; 3],
    pub unit: Option<String>,
    pub labels: Vec<String>,
    /// Planes that ImageJ says there are, which may have no pages of their own.
    pub planes: Option<u64>,
}

/// How pages follow each other.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Order {
    pub z: usize,
    pub c: usize,
    pub t: usize,
    /// Axes from the fastest on, as indices into z, c, t.
    fast: [usize; 3],
    /// Page of plane `(t * c_count + c) * z_count + z`, where the description lists them.
    listed: Option<Vec<Option<usize>>>,
}

impl Order {
    /// `pages` planes along z.
    pub fn stack(pages: usize) -> Order {
        Order { z: pages, c: 1, t: 1, fast: [0, 1, 2], listed: None }
    }

    /// Page of a plane.
    pub fn index(&self, z: usize, c: usize, t: usize) -> Option<usize> {
        if let Some(listed) = &self.listed {
            return *listed.get((t * self.c + c) * self.z + z)?;
        }
        let (at, size) = ([z, c, t], [self.z, self.c, self.t]);
        let [a, b, d] = self.fast;
        Some(at[a] + size[a] * (at[b] + size[b] * at[d]))
    }

    /// Checked against the pages there are; a description without sizes means a plain stack.
    pub fn fit(self, path: &Path, pages: usize) -> Result<Order> {
        if self.z == 0 {
            return Ok(Order::stack(pages));
        }
        let need = self.z.checked_mul(self.c).and_then(|n| n.checked_mul(self.t));
        if self.listed.is_none() && need != Some(pages) {
            let text = format!(
                "the description promises {} slices x {} channels x {} times, but there are {pages} pages",
                self.z, self.c, self.t
            );
            return Err(Error::file(path, text));
        }
        Ok(self)
    }
}

/// Reads a description; `resolution` is pixels per unit along y, x.
pub fn describe(path: &Path, text: &str, resolution: [Option<f64>; 2]) -> Result<Described> {
    let plain = Described { order: Order::default(), spacing: [1.0; 3], unit: None, labels: Vec::new(), planes: None };
    if text.starts_with("ImageJ=") {
        Ok(imagej(text, resolution, plain))
    } else if text.contains("<OME") {
        ome(path, text, plain)
    } else {
        Ok(plain)
    }
}

fn imagej(text: &str, resolution: [Option<f64>; 2], plain: Described) -> Described {
    let get =
        |name: &str| text.lines().find_map(|l| l.split_once('=').filter(|(k, _)| k.trim() == name)).map(|p| p.1.trim());
    let count = |name: &str| get(name).and_then(|v| v.parse::<usize>().ok()).filter(|n| *n > 0);
    let images = count("images").unwrap_or(1);
    let (c, t) = (count("channels").unwrap_or(1), count("frames").unwrap_or(1));
    let rest = images.checked_div(c.saturating_mul(t)).unwrap_or(1).max(1);
    let mut z = count("slices").unwrap_or(rest);
    let mut t = t;
    if get("slices").is_none() && get("frames").is_none() && get("channels").is_none() {
        (z, t) = (images, 1);
    }
    let unit = get("unit").and_then(units::normalise);
    let sane = |v: &f64| v.is_finite() && *v > 0.0;
    let mut spacing = [1.0; 3];
    spacing[0] = get("spacing").and_then(|v| v.parse::<f64>().ok()).map(f64::abs).filter(sane).unwrap_or(1.0);
    for (i, per) in resolution.into_iter().enumerate() {
        // Without a unit the resolution is a printer's, not a microscope's.
        if let Some(size) = per.map(|p| 1.0 / p).filter(sane).filter(|_| unit.is_some()) {
            spacing[i + 1] = size;
        }
    }
    let order = Order { z, c, t, fast: [1, 0, 2], listed: None };
    Described { order, spacing, unit, planes: Some(images as u64), ..plain }
}

/// Attributes of the tags named `tag`, with the text after each.
fn tags<'a>(xml: &'a str, tag: &'a str) -> impl Iterator<Item = (&'a str, &'a str)> + 'a {
    let mut rest = xml;
    std::iter::from_fn(move || {
        loop {
            let at = rest.find('<')?;
            let inside = &rest[at + 1..];
            let (body, after) = inside.split_once('>')?;
            rest = after;
            let name = body.split(|c: char| c.is_whitespace() || c == '/').next().unwrap_or("");
            if name.rsplit(':').next() == Some(tag) {
                return Some((body, after));
            }
        }
    })
}

/// Value of an attribute in the body of a tag.
fn attribute<'a>(body: &'a str, name: &str) -> Option<&'a str> {
    let mut rest = body;
    loop {
        let at = rest.find(name)?;
        let before = rest[..at].chars().next_back();
        let after = rest[at + name.len()..].trim_start();
        rest = &rest[at + name.len()..];
        if before.is_none_or(char::is_whitespace)
            && let Some(value) = after.strip_prefix('=')
        {
            let value = value.trim_start();
            let quote = value.chars().next().filter(|q| matches!(q, '"' | '\''))?;
            return value[1..].split(quote).next();
        }
    }
}

/// Planes that a list of `TiffData` may name.
const MOST_LISTED: usize = 1 << 24;

fn ome(path: &Path, xml: &str, plain: Described) -> Result<Described> {
    let Some((pixels, after)) = tags(xml, "Pixels").next() else { return Ok(plain) };
    let body = after.split("</Pixels").next().unwrap_or(after);
    let count = |name: &str| -> Result<usize> {
        let text = attribute(pixels, name).unwrap_or("1");
        let broken = || Error::file(path, format!("broken OME description: {name} = {text}"));
        text.parse::<usize>().ok().filter(|n| (1..1 << 24).contains(n)).ok_or_else(broken)
    };
    let (z, c, t) = (count("SizeZ")?, count("SizeC")?, count("SizeT")?);
    let axes = attribute(pixels, "DimensionOrder").unwrap_or("XYZCT");
    let fast: Vec<usize> = axes.chars().filter_map(|a| "ZCT".find(a)).collect();
    let mut sorted = fast.clone();
    sorted.sort();
    if sorted != [0, 1, 2] {
        return Err(Error::file(path, format!("broken OME description: DimensionOrder {axes}")));
    }
    let mut order = Order { z, c, t, fast: [fast[0], fast[1], fast[2]], listed: None };
    order.listed = listed(path, body, &order)?;
    let length = |axis: &str| attribute(pixels, &format!("PhysicalSize{axis}")).and_then(|v| v.parse::<f64>().ok());
    let mut described = Described { order, ..plain };
    // Sizes without a unit are micrometres, as the schema has it.
    let unit = |axis: &str| {
        let named = attribute(pixels, &format!("PhysicalSize{axis}Unit")).map(unescape);
        length(axis).map(|_| named.map_or(Some("micrometer".into()), |u| units::normalise(&u)))
    };
    described.unit = ["X", "Y", "Z"].into_iter().find_map(unit).flatten();
    for (i, axis) in ["Z", "Y", "X"].into_iter().enumerate() {
        let own = unit(axis).unwrap_or_else(|| described.unit.clone());
        let size = length(axis).filter(|v| v.is_finite() && *v > 0.0);
        let size = size.map(|v| units::to_one(v, described.unit.as_deref(), own.as_deref())).transpose();
        described.spacing[i] = size.map_err(|why| Error::file(path, why))?.unwrap_or(1.0);
    }
    described.labels =
        tags(body, "Channel").map(|(b, _)| attribute(b, "Name").map(unescape).unwrap_or_default()).collect();
    Ok(described)
}

/// The pages that `TiffData` elements name; `None` where pages simply follow the dimension order.
fn listed(path: &Path, body: &str, order: &Order) -> Result<Option<Vec<Option<usize>>>> {
    let own = path.file_name().unwrap_or_default().to_string_lossy();
    if let Some((b, _)) = tags(body, "UUID").find(|(b, _)| attribute(b, "FileName").is_some_and(|n| unescape(n) != own))
    {
        let other = attribute(b, "FileName").unwrap_or("");
        return Err(Error::file(
            path,
            format!("the OME-TIFF is spread over several files ({other}), which is not read; save it as one file"),
        ));
    }
    if !tags(body, "TiffData").any(|(b, _)| attribute(b, "IFD").is_some()) {
        return Ok(None);
    }
    let total = order.z.saturating_mul(order.c).saturating_mul(order.t);
    if total > MOST_LISTED {
        return Err(Error::file(
            path,
            format!("the OME description promises {total} planes; at most {MOST_LISTED} are read"),
        ));
    }
    let plain = Order { listed: None, ..order.clone() };
    // Plane number in the dimension order, to the index into the list.
    let mut slots = vec![0; total];
    for t in 0..order.t {
        for c in 0..order.c {
            for z in 0..order.z {
                if let Some(slot) = plain.index(z, c, t).and_then(|i| slots.get_mut(i)) {
                    *slot = (t * order.c + c) * order.z + z;
                }
            }
        }
    }
    let mut list = vec![None; total];
    let mut left = total.saturating_mul(2);
    for (b, _) in tags(body, "TiffData") {
        let number = |name: &str| attribute(b, name).and_then(|v| v.parse::<usize>().ok());
        let first =
            plain.index(number("FirstZ").unwrap_or(0), number("FirstC").unwrap_or(0), number("FirstT").unwrap_or(0));
        let planes = number("PlaneCount").unwrap_or(if number("IFD").is_some() { 1 } else { total });
        let (first, ifd) = (first.unwrap_or(total), number("IFD").unwrap_or(0));
        let planes = planes.min(total.saturating_sub(first));
        let Some(rest) = left.checked_sub(planes) else {
            return Err(Error::file(path, format!("the OME description places more than {total} planes twice")));
        };
        left = rest;
        for k in 0..planes {
            list[slots[first + k]] = ifd.checked_add(k);
        }
    }
    Ok(Some(list))
}

fn unescape(text: &str) -> String {
    let text = text.replace("&#181;", "µ").replace("&#xB5;", "µ").replace("&#197;", "Å");
    text.replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", "\"").replace("&apos;", "'").replace("&amp;", "&")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn imagej_lines_give_spacing_unit_and_order() {
        let text =
            "ImageJ=1.53\nimages=12\nchannels=2\nslices=3\nframes=2\nhyperstack=true\nunit=\\u00B5m\nspacing=0.5\n";
        let d = describe(Path::new("a.tif"), text, [Some(4.0), Some(8.0)]).unwrap();
        assert_eq!((d.spacing, d.unit.as_deref()), ([0.5, 0.25, 0.125], Some("micrometer")));
        let order = d.order.fit(Path::new("a.tif"), 12).unwrap();
        assert_eq!((order.z, order.c, order.t), (3, 2, 2));
        assert_eq!(order.index(2, 1, 1), Some(1 + 2 * (2 + 3)));
    }

    #[test]
    fn ome_pixels_give_sizes_units_and_listed_pages() {
        let xml = r#"<?xml version="1.0"?><OME><Image><Pixels DimensionOrder="XYCZT" SizeX="4" SizeY="4" SizeZ="2" SizeC="2"
            SizeT="1" PhysicalSizeX="0.1" PhysicalSizeXUnit="&#181;m" PhysicalSizeZ="0.3" Type="uint8">
            <Channel ID="Channel:0:0" Name="DAPI"/><Channel ID="Channel:0:1"/>
            <TiffData IFD="3" FirstZ="0" FirstC="0"/><TiffData IFD="1" FirstC="1" PlaneCount="2"/></Pixels></Image></OME>"#;
        let d = describe(Path::new("a.ome.tif"), xml, [None, None]).unwrap();
        assert_eq!((d.spacing, d.unit.as_deref()), ([0.3, 1.0, 0.1], Some("micrometer")));
        assert_eq!(d.labels, ["DAPI", ""]);
        assert_eq!(d.order.index(0, 0, 0), Some(3));
        assert_eq!(d.order.index(0, 1, 0), Some(1));
        assert_eq!(d.order.index(1, 0, 0), Some(2));
        assert_eq!(d.order.index(1, 1, 0), None);
    }

    #[test]
    fn attribute_names_match_whole_words_only() {
        let body = r#"Pixels PhysicalSizeXUnit="nm" PhysicalSizeX = '2'"#;
        assert_eq!(attribute(body, "PhysicalSizeX"), Some("2"));
        assert_eq!(attribute(body, "SizeX"), None);
    }
}
