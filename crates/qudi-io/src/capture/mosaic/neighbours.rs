//! Differences between neighbouring pixels, at every place of a tile of 4 x 4: they tell which neighbours are
//! behind the same colour.
//!
//! Structure of the scene makes neighbours of one direction differ as much at every place of the tile. A
//! colour filter adds to the differences where two colours meet. Energies of differences are products of two
//! sums over disjoint pixels of a block, in which noise vanishes in the mean.

use qudi_core::Size;

/// Rows and columns from a pixel to its neighbour.
const DIRECTIONS: [(usize, isize); 4] = [(0, 1), (1, 0), (1, 1), (1, -1)];

/// Places of a tile.
const PLACES: usize = 16;

/// Side of a tile.
const SIDE: usize = 4;

/// Side of a block of pixels.
const BLOCK_SIDE: usize = 16;

/// Tiles in each of the two parts of a block.
const TILES: f64 = 8.0;

/// Least light of a block in units of the mean.
const MIN_LIGHT: f64 = 0.15;

/// Least number of lit blocks for an answer.
const MIN_BLOCKS: usize = 12;

/// Standard errors beyond which a difference is none by chance. Of 24 photographs at 3.25 photons, two
/// neighbours behind one colour reach 4, and every filter of another kind or phase 6.7.
const MIN_Z_SCORE: f64 = 5.5;

/// Least difference of two colours, as a share of the mean.
const MIN_CONTRAST: f64 = 0.06;

/// Largest energy of alike neighbours in units of the one of different colours.
const MAX_ALIKE: f64 = 0.5;

/// Largest energy of alike neighbours in units of the one of different colours, for a pattern to fit.
const MAX_ALIKE_OF_FIT: f64 = 0.3;

/// Which neighbours in every direction, at every place of a tile, are behind one colour.
pub(super) type SameColour = [[bool; PLACES]; 4];

/// Two neighbours of one colour that differ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Difference {
    /// Row and column of the first pixel in a tile.
    pub(super) at: (usize, usize),
    /// Difference as a share of the mean light.
    pub(super) contrast: f64,
}

/// Energies of the differences between neighbours, in units of the squared mean of their block.
pub(super) struct NeighbourDifferences {
    /// For each direction, the energy at every place of a tile in every lit block.
    blocks: [Vec<[f64; PLACES]>; 4],
    /// Their means over blocks.
    means: [[f64; PLACES]; 4],
}

/// Compares the colours that `letter` returns for a row and a column.
pub(super) fn same_colour(letter: impl Fn(usize, usize) -> char) -> SameColour {
    DIRECTIONS.map(|direction| {
        std::array::from_fn(|place| {
            let (a, b) = neighbours(place / SIDE, place % SIDE, direction);
            letter(a.0, a.1) == letter(b.0, b.1)
        })
    })
}

/// Returns the two pixels that are compared at a place of the picture.
fn neighbours(
    row: usize,
    column: usize,
    (down, across): (usize, isize),
) -> ((usize, usize), (usize, usize)) {
    let right = across.max(0) as usize;
    let left = (-across).max(0) as usize;
    ((row, column + left), (row + down, column + right))
}

impl NeighbourDifferences {
    /// Measures the picture `sums`; `None` if too little of it is lit.
    pub(super) fn new(sums: &[u32], size: Size) -> Option<Self> {
        let (down, across) = (size.height / BLOCK_SIDE, size.width / BLOCK_SIDE);
        let corners = || (0..down * across).map(|i| (i / across, i % across));
        let light: Vec<f64> = corners().map(|corner| mean_light(sums, size, corner)).collect();
        let least = MIN_LIGHT * light.iter().sum::<f64>() / light.len().max(1) as f64;
        let mut blocks: [Vec<[f64; PLACES]>; 4] = Default::default();
        for (corner, &light) in corners().zip(&light).filter(|&(_, &l)| l > 0.0 && l >= least) {
            for (blocks, direction) in blocks.iter_mut().zip(DIRECTIONS) {
                blocks.push(energies(sums, size, corner, direction).map(|e| e / (light * light)));
            }
        }
        let number = blocks[0].len();
        let mean = |blocks: &Vec<[f64; PLACES]>| {
            std::array::from_fn(|place| {
                blocks.iter().map(|block| block[place]).sum::<f64>() / number as f64
            })
        };
        let means = blocks.each_ref().map(mean);
        (number >= MIN_BLOCKS).then_some(Self { blocks, means })
    }

    /// Returns the clearest difference between neighbours that are said to be of one colour: more than at
    /// other places in the same row of tiles, or in the same column. Stripes along one axis are no colours.
    pub(super) fn within_colours(&self, same: &SameColour) -> Option<Difference> {
        let mut clearest = (MIN_Z_SCORE, None);
        for (direction, (means, same)) in self.means.iter().zip(same).enumerate() {
            for place in (0..PLACES).filter(|&place| same[place]) {
                let (row, column) = (place / SIDE, place % SIDE);
                let least = |places: [usize; SIDE]| {
                    places.into_iter().min_by(|&a, &b| means[a].total_cmp(&means[b]))
                };
                let alike = [
                    least(std::array::from_fn(|x| row * SIDE + x)),
                    least(std::array::from_fn(|y| y * SIDE + column)),
                ];
                let alike =
                    alike.into_iter().flatten().max_by(|&a, &b| means[a].total_cmp(&means[b]));
                let Some(alike) = alike else { continue };
                let excess = means[place] - means[alike];
                if excess < MIN_CONTRAST.powi(2) || means[alike] > MAX_ALIKE * means[place] {
                    continue;
                }
                let z_score = z_score(self.blocks[direction].iter().map(|e| e[place] - e[alike]));
                if z_score > clearest.0 {
                    let difference = Difference { at: (row, column), contrast: excess.sqrt() };
                    clearest = (z_score, Some(difference));
                }
            }
        }
        clearest.1
    }

    /// Returns the standard errors by which neighbours of two colours differ more than neighbours of one, if
    /// all of one colour are alike.
    pub(super) fn z_score(&self, same: &SameColour) -> Option<f64> {
        if self.within_colours(same).is_some() {
            return None;
        }
        let (mut alike, mut different) = (0.0, 0.0);
        for (means, same) in self.means.iter().zip(same) {
            let number = same.iter().filter(|&&same| same).count();
            if number == 0 || number == PLACES {
                continue;
            }
            for (mean, &same) in means.iter().zip(same) {
                if same {
                    alike += mean / number as f64;
                } else {
                    different += mean / (PLACES - number) as f64;
                }
            }
        }
        if alike > MAX_ALIKE_OF_FIT * different {
            return None;
        }
        let of_block = |block: usize| {
            let directions = self.blocks.iter().zip(same).map(|(blocks, same)| {
                let mean = |of: bool| {
                    let each = blocks[block].iter().zip(same).filter(|&(_, &same)| same == of);
                    let (sum, number) = each.fold((0.0, 0.0), |(s, n), (e, _)| (s + e, n + 1.0));
                    (number > 0.0).then(|| sum / number)
                };
                mean(false).zip(mean(true)).map_or(0.0, |(different, alike)| different - alike)
            });
            directions.sum::<f64>()
        };
        let z_score = z_score((0..self.blocks[0].len()).map(of_block));
        (z_score > MIN_Z_SCORE).then_some(z_score)
    }
}

/// Returns the mean of the pixels of a block.
fn mean_light(sums: &[u32], size: Size, (down, across): (usize, usize)) -> f64 {
    let rows = down * BLOCK_SIDE..(down + 1) * BLOCK_SIDE;
    let first = across * BLOCK_SIDE;
    let row = |y: usize| &sums[y * size.width + first..][..BLOCK_SIDE];
    let sum: f64 = rows.flat_map(row).map(|&sum| f64::from(sum)).sum();
    sum / (BLOCK_SIDE * BLOCK_SIDE) as f64
}

/// Returns the energies of differences in a block: the product of the sums over two halves of its tiles.
fn energies(
    sums: &[u32],
    size: Size,
    (down, across): (usize, usize),
    direction: (usize, isize),
) -> [f64; PLACES] {
    let mut halves = [[0.0; PLACES]; 2];
    for y in 0..BLOCK_SIDE {
        for x in 0..BLOCK_SIDE {
            let (a, b) = neighbours(down * BLOCK_SIDE + y, across * BLOCK_SIDE + x, direction);
            if b.0 >= size.height || a.1.max(b.1) >= size.width {
                continue;
            }
            let value = |(y, x): (usize, usize)| f64::from(sums[y * size.width + x]);
            let half = (y / SIDE + x / SIDE) % 2;
            halves[half][y % SIDE * SIDE + x % SIDE] += value(a) - value(b);
        }
    }
    std::array::from_fn(|place| halves[0][place] * halves[1][place] / (TILES * TILES))
}

/// Returns the mean in units of its standard error.
fn z_score(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let number = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / number;
    let variance = values.map(|value| (value - mean).powi(2)).sum::<f64>() / number;
    mean / (variance / number).sqrt().max(f64::MIN_POSITIVE)
}
