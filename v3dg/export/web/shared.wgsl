// What project.wgsl and draw.wgsl share. The renderer puts this text before both.

struct Camera {
  focal: vec2f,  // px
  center: vec2f,  // px
  size: vec2f,  // px
  near: f32,
  count: u32,  // gaussians of the cut
  lowest_slope: vec2f,
  highest_slope: vec2f,
  background: vec4f,
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
  blue: u32,
}

const kLog2MinAlpha = -7.994353436858858;
