// Decodes the gaussians of a cut from their codes and projects them: one thread a
// gaussian. The formulas are those of csrc/quantize/quantize_math.h,
// csrc/project/project_math.h and csrc/math/sh.h, which explain them.

// An instance in front of the camera. A point p of the instance is at
// linear (p - eye) + translation.
struct Placement {
  row_x: vec4f,  // row of `linear`, and component of the translation
  row_y: vec4f,
  row_z: vec4f,
  eye: vec4f,
  eye_rest: vec4f,  // eye + eye_rest is the position of the camera
  tint: vec4f,
}

// A cluster of the cut, for one instance. Words count from the start of the pool.
struct Pair {
  placement: u32,
  end: u32,  // gaussians of the cut up to and including this pair
  record_word: u32,
  sh_word: u32,
  range_word: u32,
  filter_px2: f32,
  look: u32,  // kAntialiased, kLimited, and the degree from bit 4 on
  weight: f32,
}

// As Sizes, whose numbers other workgroups change meanwhile.
struct CountedSizes {
  num_keys: u32,
  lowest_key: atomic<u32>,
  highest_key: atomic<u32>,
  num_items: atomic<u32>,
}

const kThreads = 256u;
const kAntialiased = 1u;
const kLimited = 2u;
const kDegreeShift = 4u;

const kMinAlpha = 0.00392156862745098;
const kFalloffScale = 0.8493218002880191;
const kMostFilterOfVariance = 4.0;
const kLargest = 3.4028234e38;
const kLargestHalf = 65504.0;

const kLeastScaleBits = 528482304u;  // 63 << 23
const kZeroQuat = 255.0;
const kQuatLength2 = 444016.0;
const kQuatStep = 0.0015007235;
const kStepUnit = 0.00390625;

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> pool: array<u32>;
@group(0) @binding(2) var<storage, read> pairs: array<Pair>;
@group(0) @binding(3) var<storage, read> first_pairs: array<u32>;
@group(0) @binding(4) var<storage, read> placements: array<Placement>;
@group(0) @binding(5) var<storage, read_write> records: array<Record>;
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sizes: CountedSizes;

fn low_half(word: u32) -> f32 {
  return unpack2x16float(word).x;
}

fn high_half(word: u32) -> f32 {
  return unpack2x16float(word).y;
}

// Returns half number `index` of an array of halves that starts at a word.
fn half_at(first_word: u32, index: u32) -> f32 {
  let halves = unpack2x16float(pool[first_word + index / 2u]);
  return select(halves.x, halves.y, index % 2u == 1u);
}

struct Gaussian {
  mean: vec3f,
  quat: vec4f,  // w, x, y, z
  scale: vec3f,
  opacity: f32,
  color: vec3f,  // coefficients of degree 0
}

fn scale_of(code: u32, packed: u32) -> f32 {
  let first = kLeastScaleBits + ((packed & 0xffffu) << 14u);
  return bitcast<f32>(first + code * ((packed >> 16u) << 4u));
}

fn decode(record_word: u32, range_word: u32) -> Gaussian {
  let a = pool[record_word];
  let b = pool[record_word + 1u];
  let c = pool[record_word + 2u];
  let d = pool[record_word + 3u];
  var g: Gaussian;
  let mean_code = vec3u(a & 4095u, (a >> 12u) & 4095u, b & 4095u);
  for (var k = 0u; k < 3u; k++) {
    let first = bitcast<f32>(pool[range_word + k]);
    let step = bitcast<f32>(pool[range_word + 3u + k]);
    g.mean[k] = first + f32(mean_code[k]) * step;
  }
  let packed_scale = pool[range_word + 9u];
  g.scale.x = scale_of((b >> 12u) & 1023u, packed_scale);
  g.scale.y = scale_of(b >> 22u, packed_scale);
  g.scale.z = scale_of(c & 1023u, packed_scale);
  g.opacity = f32(a >> 24u) * (1.0 / 255.0);
  let color_code = vec3u((c >> 28u) | ((d & 31u) << 4u), (d >> 5u) & 511u, (d >> 14u) & 511u);
  for (var k = 0u; k < 3u; k++) {
    let first = half_at(range_word + 6u, k);
    let step = half_at(range_word + 6u, 3u + k) * kStepUnit;
    g.color[k] = first + f32(color_code[k]) * step;
  }
  let xyz = vec3f(f32((c >> 10u) & 511u), f32((c >> 19u) & 511u), f32(d >> 23u)) - kZeroQuat;
  g.quat = vec4f(sqrt(kQuatLength2 - dot(xyz, xyz)), xyz) * kQuatStep;
  return g;
}

// Returns the bits [first, first + count) of an array of words.
fn bits_at(first_word: u32, first: u32, count: u32) -> u32 {
  let word = first_word + first / 32u;
  let shift = first % 32u;
  var bits = pool[word] >> shift;
  if (shift + count > 32u) {
    bits |= pool[word + 1u] << (32u - shift);
  }
  return bits & ((1u << count) - 1u);
}

// Returns the bits of brightness, orange and green of a coefficient.
fn sh_bits(degree: u32, band: u32) -> vec3u {
  if (degree == 1u) {
    return vec3u(7u, 7u, 7u);
  }
  if (degree == 2u) {
    return vec3u(7u, 5u, 4u);
  }
  return vec3u(select(6u, 5u, band == 1u), 4u, 3u);
}

fn sh_base(index: u32, v: vec3f) -> f32 {
  let vv = v * v;
  switch index {
    case 1u: { return -0.4886025119029199 * v.y; }
    case 2u: { return 0.4886025119029199 * v.z; }
    case 3u: { return -0.4886025119029199 * v.x; }
    case 4u: { return 1.0925484305920792 * v.x * v.y; }
    case 5u: { return -1.0925484305920792 * v.y * v.z; }
    case 6u: { return 0.31539156525252005 * (2.0 * vv.z - vv.x - vv.y); }
    case 7u: { return -1.0925484305920792 * v.x * v.z; }
    case 8u: { return 0.5462742152960396 * (vv.x - vv.y); }
    case 9u: { return -0.5900435899266435 * v.y * (3.0 * vv.x - vv.y); }
    case 10u: { return 2.890611442640554 * v.x * v.y * v.z; }
    case 11u: { return -0.4570457994644658 * v.y * (4.0 * vv.z - vv.x - vv.y); }
    case 12u: { return 0.3731763325901154 * v.z * (2.0 * vv.z - 3.0 * vv.x - 3.0 * vv.y); }
    case 13u: { return -0.4570457994644658 * v.x * (4.0 * vv.z - vv.x - vv.y); }
    case 14u: { return 1.445305721320277 * v.z * (vv.x - vv.y); }
    default: { return -0.5900435899266435 * v.x * (vv.x - 3.0 * vv.y); }
  }
}

// Returns the sum of the coefficients of the degrees above 0, times their bases.
fn color_of_codes(sh_word: u32, step_word: u32, degree: u32, direction: vec3f) -> vec3f {
  var sum = vec3f(0.0);
  var first = 0u;
  for (var index = 1u; index < (degree + 1u) * (degree + 1u); index++) {
    let band = select(select(3u, 2u, index < 9u), 1u, index < 4u);
    let counts = sh_bits(degree, band);
    var value: vec3f;
    for (var channel = 0u; channel < 3u; channel++) {
      let count = counts[channel];
      let middle = f32((1u << (count - 1u)) - 1u);
      let code = f32(bits_at(sh_word, first, count)) - middle;
      let step = half_at(step_word, 3u * (band - 1u) + channel) * kStepUnit;
      value[channel] = code * abs(code) * step;
      first += count;
    }
    let base = value.x - value.z;
    sum += sh_base(index, direction) * vec3f(base + value.y, value.x + value.z, base - value.y);
  }
  return sum;
}

fn rotation_of(q: vec4f) -> mat3x3f {
  // Columns of the rotation matrix of the quaternion (w, x, y, z).
  let s = 2.0 / dot(q, q);
  let w = q.x;
  let x = q.y;
  let y = q.z;
  let z = q.w;
  return mat3x3f(
    1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y),
    s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x),
    s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y),
  );
}

// Returns the pair of a gaussian. The pair of the first gaussian of each workgroup is
// known, and pairs with the same end are empty.
fn pair_of(gaussian: u32) -> u32 {
  var pair = first_pairs[gaussian / kThreads];
  while (pairs[pair].end <= gaussian) {
    pair++;
  }
  return pair;
}

// Returns the number of tiles with a pixel centre in the ellipse.
fn num_tiles_reached(record: Record, reach: f32) -> u32 {
  let l = vec3f(record.l11, record.l12, record.l22);
  let num_tiles = num_tiles_of(camera.size);
  let rows = tile_rows_of(record.center, l, reach, num_tiles.y);
  var count = 0u;
  for (var row = rows.x; row < rows.y; row++) {
    let columns = tile_columns_of(record.center, l, reach, row, num_tiles.x);
    count += columns.y - columns.x;
  }
  return count;
}

// Writes the record of a gaussian, and returns the bits of its depth; kNotDrawn if it
// is not in the picture.
fn project_one(index: u32) -> u32 {
  let pair_index = pair_of(index);
  let pair = pairs[pair_index];
  let degree = pair.look >> kDegreeShift;
  var first = 0u;
  if (pair_index > 0u) {
    first = pairs[pair_index - 1u].end;
  }
  let row = index - first;
  let g = decode(pair.record_word + 4u * row, pair.range_word);

  let place = placements[pair.placement];
  let from_eye = g.mean - place.eye.xyz;
  let p = vec3f(
    dot(place.row_x.xyz, from_eye) + place.row_x.w,
    dot(place.row_y.xyz, from_eye) + place.row_y.w,
    dot(place.row_z.xyz, from_eye) + place.row_z.w,
  );
  if (!(p.z >= camera.near) || g.opacity < kMinAlpha) {
    return kNotDrawn;
  }

  // The rows of J W R S.
  let rotation = rotation_of(g.quat);
  let inverse_z = 1.0 / p.z;
  let slope = clamp(p.xy * inverse_z, camera.lowest_slope, camera.highest_slope);
  let row_1 = camera.focal.x * inverse_z * (place.row_x.xyz - slope.x * place.row_z.xyz);
  let row_2 = camera.focal.y * inverse_z * (place.row_y.xyz - slope.y * place.row_z.xyz);
  let a1 = (row_1 * rotation) * g.scale;
  let a2 = (row_2 * rotation) * g.scale;

  let normal = cross(a1, a2);
  let n11 = dot(a1, a1);
  let n22 = dot(a2, a2);
  let det0 = dot(normal, normal);
  var filter_px2 = pair.filter_px2;
  if ((pair.look & kLimited) != 0u) {
    filter_px2 = min(filter_px2, kMostFilterOfVariance * sqrt(det0));
  }
  let c11 = n11 + filter_px2;
  let c22 = n22 + filter_px2;
  let c12 = dot(a1, a2);
  let det = det0 + filter_px2 * (n11 + n22) + filter_px2 * filter_px2;

  var record: Record;
  record.center = camera.focal * p.xy * inverse_z + camera.center;
  record.l11 = kFalloffScale * sqrt(c22 / det);
  record.l12 = -c12 / c22 * record.l11;
  record.l22 = kFalloffScale / sqrt(c22);
  var log2_opacity = log2(g.opacity);
  if ((pair.look & kAntialiased) != 0u) {
    log2_opacity += 0.5 * log2(det0 / det);
  }
  record.log2_opacity = log2_opacity + log2(pair.weight);

  let reach = record.log2_opacity - kLog2MinAlpha;
  if (!(reach >= 0.0 && det > 0.0 && det < kLargest && c11 < kLargest && c22 < kLargest)) {
    return kNotDrawn;
  }
  let num_tiles = num_tiles_reached(record, reach);
  if (num_tiles == 0u) {
    return kNotDrawn;
  }

  var color = 0.28209479177387814 * g.color + 0.5;
  if (degree > 0u) {
    let away = from_eye - place.eye_rest.xyz;
    let direction = away * inverseSqrt(max(dot(away, away), 1e-37));
    let step_word = pair.range_word + 10u;
    color += color_of_codes(pair.sh_word + 2u * degree * row, step_word, degree, direction);
  }
  color = min(max(color, vec3f(0.0)) * place.tint.rgb, vec3f(kLargestHalf));
  record.red_green = pack2x16float(color.rg);
  record.blue_tiles = pack2x16float(vec2f(color.b, 0.0)) | (num_tiles << 16u);
  records[index] = record;
  return bitcast<u32>(p.z);
}

var<workgroup> lowest_key: atomic<u32>;
var<workgroup> highest_key: atomic<u32>;
var<workgroup> num_drawn: atomic<u32>;

@compute @workgroup_size(kThreads)
fn project(
  @builtin(global_invocation_id) id: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  if (thread == 0u) {
    atomicStore(&lowest_key, kNotDrawn);
    atomicStore(&highest_key, 0u);
    atomicStore(&num_drawn, 0u);
  }
  workgroupBarrier();
  if (id.x < camera.count) {
    let key = project_one(id.x);
    keys[id.x] = key;
    if (key != kNotDrawn) {
      atomicMin(&lowest_key, key);
      atomicMax(&highest_key, key);
      atomicAdd(&num_drawn, 1u);
    }
  }
  workgroupBarrier();
  if (thread == 0u && atomicLoad(&num_drawn) > 0u) {
    atomicMin(&sizes.lowest_key, atomicLoad(&lowest_key));
    atomicMax(&sizes.highest_key, atomicLoad(&highest_key));
    atomicAdd(&sizes.num_items, atomicLoad(&num_drawn));
  }
}
