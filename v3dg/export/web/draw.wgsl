// Blends the gaussians of each tile from front to back, and finishes the picture. The
// falloff and the blend step are those of csrc/rasterize/rasterize_math.h.

const kThreads = 256u;  // a workgroup for each tile, a thread for each pixel
const kMaxAlpha = 0.999;

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> records: array<Record>;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
@group(0) @binding(3) var<storage, read> gaussians: array<u32>;
@group(0) @binding(4) var<storage, read> pair_sizes: Sizes;
// [tile] first pair, and the pair after the last one
@group(0) @binding(5) var<storage, read_write> found_ranges: array<vec2u>;
@group(0) @binding(6) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(7) var blended: texture_storage_2d<rgba32float, write>;

const kPairsOfThread = 4u;

// Finds the pairs of each tile. The ranges must be zero before.
@compute @workgroup_size(kThreads)
fn find_ranges(
  @builtin(workgroup_id) group: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  for (var k = 0u; k < kPairsOfThread; k++) {
    let pair = (group.x * kPairsOfThread + k) * kThreads + thread;
    if (pair >= pair_sizes.num_keys) {
      return;
    }
    let tile = tiles[pair];
    if (tile >= arrayLength(&found_ranges)) {
      return;
    }
    if (pair == 0u || tiles[max(pair, 1u) - 1u] != tile) {
      found_ranges[tile].x = pair;
    }
    if (pair + 1u == pair_sizes.num_keys || tiles[pair + 1u] != tile) {
      found_ranges[tile].y = pair + 1u;
    }
  }
}

// Windows of 8 x 4 pixels: 2 columns and 4 rows of them are a tile.
const kWindow_px = vec2u(8u, 4u);
const kPixelsOfWindow = 32u;
const kWordsOfBatch = kThreads / 32u;

// The gaussians of a batch: the centre relative to the tile, l11 and l12; l22 and the
// opacity; the colour.
var<workgroup> batch_center_l1: array<vec4f, kThreads>;
var<workgroup> batch_l22_opacity: array<vec2f, kThreads>;
var<workgroup> batch_color: array<vec3f, kThreads>;
// Bits of the windows that a gaussian reaches.
var<workgroup> batch_windows: array<u32, kThreads>;
// [window][word] bits of the gaussians of the batch that reach a window
var<workgroup> window_gaussians: array<u32, 8u * kWordsOfBatch>;
var<workgroup> num_live: atomic<u32>;
var<workgroup> is_any_live: u32;

fn windows_of(center: vec2f, l: vec3f, reach: f32) -> u32 {
  var windows = 0u;
  for (var row = 0u; row < 4u; row++) {
    let first_row = f32(kWindow_px.y * row) + 0.5 - center.y;
    let range = columns_between(l, reach, first_row, first_row + 3.0) + center.x;
    if (range.x <= 7.5 && range.y >= 0.5) {
      windows |= 1u << (2u * row);
    }
    if (range.x <= 15.5 && range.y >= 8.5) {
      windows |= 2u << (2u * row);
    }
  }
  return windows;
}

// Loads one gaussian of a batch.
fn load(thread: u32, gaussian: u32, origin: vec2f) {
  let record = records[gaussian];
  let center = record.center - origin;
  let l = vec3f(record.l11, record.l12, record.l22);
  let reach = max(record.log2_opacity - kLog2MinAlpha, 0.0);
  batch_center_l1[thread] = vec4f(center, l.xy);
  batch_l22_opacity[thread] = vec2f(l.z, record.log2_opacity);
  let blue = unpack2x16float(record.blue_tiles).x;
  batch_color[thread] = vec3f(unpack2x16float(record.red_green), blue);
  batch_windows[thread] = windows_of(center, l, reach);
}

// Sets one word of `window_gaussians`.
fn gather_window_bits(index: u32) {
  let window = index / kWordsOfBatch;
  let first = 32u * (index % kWordsOfBatch);
  var bits = 0u;
  for (var k = 0u; k < 32u; k++) {
    bits |= ((batch_windows[first + k] >> window) & 1u) << k;
  }
  window_gaussians[index] = bits;
}

struct Pixel {
  color: vec3f,
  transmittance: f32,
  is_live: bool,
}

// Blends the gaussians of the batch that reach the pixel's window.
fn blend_batch(pixel: ptr<function, Pixel>, center: vec2f, window: u32) {
  for (var word = 0u; word < kWordsOfBatch; word++) {
    var bits = window_gaussians[window * kWordsOfBatch + word];
    while (bits != 0u) {
      let k = 32u * word + firstTrailingBit(bits);
      bits &= bits - 1u;
      let center_l1 = batch_center_l1[k];
      let l22_opacity = batch_l22_opacity[k];
      let d = center - center_l1.xy;
      let t1 = center_l1.z * d.x + center_l1.w * d.y;
      let t2 = l22_opacity.x * d.y;
      let exponent = l22_opacity.y - t2 * t2 - t1 * t1;
      if (exponent >= kLog2MinAlpha) {
        let weight = min(exp2(exponent), kMaxAlpha) * (*pixel).transmittance;
        (*pixel).color += weight * batch_color[k];
        (*pixel).transmittance -= weight;
        if ((*pixel).transmittance <= camera.min_transmittance) {
          (*pixel).is_live = false;
          return;
        }
      }
    }
  }
}

@compute @workgroup_size(kThreads)
fn blend(
  @builtin(workgroup_id) tile: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  let range = ranges[tile.y * num_tiles_of(camera.size).x + tile.x];
  let origin = kTileSide_px * tile.xy;
  let window = thread / kPixelsOfWindow;
  let in_window = thread % kPixelsOfWindow;
  let place = vec2u(window % 2u, window / 2u) * kWindow_px +
    vec2u(in_window % kWindow_px.x, in_window / kWindow_px.x);
  let is_inside = all(origin + place < vec2u(camera.size));
  var pixel = Pixel(vec3f(0.0), 1.0, is_inside);
  for (var first = range.x; first < range.y; first += kThreads) {
    if (thread == 0u) {
      atomicStore(&num_live, 0u);
    }
    workgroupBarrier();
    if (pixel.is_live) {
      atomicStore(&num_live, 1u);
    }
    batch_windows[thread] = 0u;
    if (first + thread < range.y) {
      load(thread, gaussians[first + thread], vec2f(origin));
    }
    workgroupBarrier();
    if (thread == 0u) {
      is_any_live = atomicLoad(&num_live);
    }
    if (thread < 8u * kWordsOfBatch) {
      gather_window_bits(thread);
    }
    if (workgroupUniformLoad(&is_any_live) == 0u) {
      break;
    }
    if (pixel.is_live) {
      blend_batch(&pixel, vec2f(place) + 0.5, window);
    }
    workgroupBarrier();
  }
  if (is_inside) {
    textureStore(blended, origin + place, finished(pixel));
  }
}

// Returns colour and alpha. A pixel that has stopped distributes the rest of its light
// over the gaussians that it has blended.
fn finished(pixel: Pixel) -> vec4f {
  if (pixel.transmittance > camera.min_transmittance) {
    return vec4f(pixel.color, 1.0 - pixel.transmittance);
  }
  return vec4f(pixel.color / (1.0 - pixel.transmittance), 1.0);
}

@group(0) @binding(8) var picture: texture_2d<f32>;

@vertex
fn cover(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(f32(vertex & 1u) * 4.0 - 1.0, f32(vertex >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn finish(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let pixel = textureLoad(picture, vec2i(position.xy), 0);
  return vec4f(pixel.rgb + (1.0 - pixel.a) * camera.background, 1.0);
}
