// What several shaders share. The renderer puts this text before the text of each
// shader.

struct Camera {
  focal: vec2f,  // px
  center: vec2f,  // px
  size: vec2f,  // px
  near: f32,
  count: u32,  // gaussians of the cut
  lowest_slope: vec2f,
  highest_slope: vec2f,
  background: vec3f,
  // A pixel stops behind the gaussian that leaves this transmittance or less.
  min_transmittance: f32,
}

// A gaussian in the picture. At offset d from the centre, alpha is
// 2^(log2_opacity - |L d|^2) with L = [[l11, l12], [0, l22]].
struct Record {
  center: vec2f,  // px
  l11: f32,
  l12: f32,
  l22: f32,
  log2_opacity: f32,
  red_green: u32,  // halves
  blue_tiles: u32,  // a half, and the number of tiles from bit 16 on
}

// The lengths of the arrays that are sorted, which only the device knows.
struct Sizes {
  num_keys: u32,
  lowest_key: u32,
  highest_key: u32,
  num_items: u32,  // gaussians in the picture, or pairs of gaussians and tiles
}

const kLog2MinAlpha = -7.994353436858858;
const kTileSide_px = 16u;
// The key of a gaussian that is not in the picture.
const kNotDrawn = 0xffffffffu;
// Devices round differently, so ellipses are widened where they are only bounded.
const kMargin_px = 0.02;

fn num_tiles_of(size: vec2f) -> vec2u {
  return (vec2u(size) + kTileSide_px - 1u) / kTileSide_px;
}

// Returns the range of x in which the ellipse with alpha = 1/255 lies between two rows.
// All are relative to its centre. `l` is (l11, l12, l22), and `reach` the largest
// |L d|^2. The range is empty if x > y.
fn columns_between(l: vec3f, reach: f32, first_row: f32, last_row: f32) -> vec2f {
  let half_height = sqrt(reach) / l.z;
  let first = max(first_row - kMargin_px, -half_height);
  let last = min(last_row + kMargin_px, half_height);
  if (first > last) {
    return vec2f(1.0, -1.0);
  }
  // The row of the leftmost point; the rightmost point is opposite.
  let turn = half_height * l.y * inverseSqrt(l.y * l.y + l.z * l.z);
  let left = clamp(turn, first, last);
  let right = clamp(-turn, first, last);
  let t_left = l.z * left;
  let t_right = l.z * right;
  return vec2f(
    (-l.y * left - sqrt(max(reach - t_left * t_left, 0.0))) / l.x - kMargin_px,
    (-l.y * right + sqrt(max(reach - t_right * t_right, 0.0))) / l.x + kMargin_px,
  );
}

// Returns the first tile, and the tile after the last one, with a pixel centre between
// two coordinates in px.
fn tiles_between(low: f32, high: f32, num_tiles: u32) -> vec2u {
  let first = max(ceil(low - 0.5), 0.0);
  let last = min(floor(high - 0.5), f32(kTileSide_px * num_tiles) - 1.0);
  if (!(first <= last)) {
    return vec2u(0u);
  }
  return vec2u(u32(first) / kTileSide_px, u32(last) / kTileSide_px + 1u);
}

fn tile_rows_of(center: vec2f, l: vec3f, reach: f32, num_rows: u32) -> vec2u {
  let half_height = sqrt(reach) / l.z + kMargin_px;
  return tiles_between(center.y - half_height, center.y + half_height, num_rows);
}

// Returns the first tile, and the tile after the last one, in a row of tiles.
fn tile_columns_of(
  center: vec2f,
  l: vec3f,
  reach: f32,
  tile_row: u32,
  num_columns: u32,
) -> vec2u {
  let first_row = f32(kTileSide_px * tile_row) + 0.5 - center.y;
  let last_row = first_row + f32(kTileSide_px - 1u);
  let range = columns_between(l, reach, first_row, last_row) + center.x;
  return tiles_between(range.x, range.y, num_columns);
}
