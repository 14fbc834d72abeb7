// Draws the records from back to front as quads, and finishes the picture. The falloff
// is that of csrc/rasterize/rasterize_math.h.

struct DrawArguments {
  num_vertices: u32,
  num_instances: u32,
  first_vertex: u32,
  first_instance: u32,
}

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) @interpolate(flat) center_l1: vec4f,
  @location(1) @interpolate(flat) l22_opacity: vec2f,
  @location(2) @interpolate(flat) color: vec3f,
}

const kMaxAlpha = 0.999;
// Devices round the corners of quads to a fraction of a pixel.
const kMargin_px = 0.02;

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> records: array<Record>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> arguments: DrawArguments;

// The quad is the parallelogram around the ellipse on which alpha is 1/255.
@vertex
fn draw_corner(
  @builtin(vertex_index) vertex: u32,
  @builtin(instance_index) instance: u32,
) -> Corner {
  let record = records[order[arguments.num_instances - 1u - instance]];
  let reach = sqrt(max(record.log2_opacity - kLog2MinAlpha, 0.0));
  let side = vec2f(f32(vertex & 1u), f32(vertex >> 1u)) * 2.0 - 1.0;
  let t1 = side.x * (reach + kMargin_px * (record.l11 + abs(record.l12)));
  let t2 = side.y * (reach + kMargin_px * record.l22);
  let dy = t2 / record.l22;
  let dx = (t1 - record.l12 * dy) / record.l11;
  let place = (record.center + vec2f(dx, dy)) / camera.size;
  var corner: Corner;
  corner.position = vec4f(2.0 * place.x - 1.0, 1.0 - 2.0 * place.y, 0.0, 1.0);
  corner.center_l1 = vec4f(record.center, record.l11, record.l12);
  corner.l22_opacity = vec2f(record.l22, record.log2_opacity);
  corner.color = vec3f(unpack2x16float(record.red_green), unpack2x16float(record.blue).x);
  return corner;
}

@fragment
fn draw_pixel(corner: Corner) -> @location(0) vec4f {
  let d = corner.position.xy - corner.center_l1.xy;
  let t1 = corner.center_l1.z * d.x + corner.center_l1.w * d.y;
  let t2 = corner.l22_opacity.x * d.y;
  let exponent = corner.l22_opacity.y - t2 * t2 - t1 * t1;
  if (exponent < kLog2MinAlpha) {
    discard;
  }
  let alpha = min(exp2(exponent), kMaxAlpha);
  return vec4f(corner.color * alpha, alpha);
}

@group(0) @binding(4) var picture: texture_2d<f32>;

@vertex
fn cover(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(f32(vertex & 1u) * 4.0 - 1.0, f32(vertex >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn finish(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let blended = textureLoad(picture, vec2i(position.xy), 0);
  return vec4f(blended.rgb + (1.0 - blended.a) * camera.background.rgb, 1.0);
}
