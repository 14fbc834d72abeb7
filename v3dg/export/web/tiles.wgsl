// Lists the pairs of gaussians and tiles of the picture, from front to back, and finds
// the range of each tile after they were sorted by tile.

const kThreads = 256u;

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var<storage, read> records: array<Record>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> sizes: Sizes;  // of the gaussians
// [workgroup] number of pairs; after sum_blocks(), of pairs before
@group(0) @binding(4) var<storage, read_write> blocks: array<u32>;
@group(0) @binding(5) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(6) var<storage, read_write> gaussians: array<u32>;
@group(0) @binding(7) var<storage, read_write> pair_sizes: Sizes;

var<workgroup> sums: array<u32, 2u * kThreads>;
const kSumSteps = 8u;

// As in sort.wgsl.
fn sum_before(thread: u32, value: u32) -> u32 {
  var sum = value;
  sums[thread] = sum;
  workgroupBarrier();
  for (var k = 0u; k < kSumSteps; k++) {
    let source = (k % 2u) * kThreads;
    if (thread >= 1u << k) {
      sum += sums[source + thread - (1u << k)];
    }
    sums[kThreads - source + thread] = sum;
    workgroupBarrier();
  }
  return sum - value;
}

fn num_tiles_at(rank: u32) -> u32 {
  if (rank >= sizes.num_items) {
    return 0u;
  }
  return records[order[rank]].blue_tiles >> 16u;
}

@compute @workgroup_size(kThreads)
fn count_pairs(
  @builtin(workgroup_id) group: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  let count = num_tiles_at(group.x * kThreads + thread);
  let before = sum_before(thread, count);
  if (thread == kThreads - 1u) {
    blocks[group.x] = before + count;
  }
}

// One workgroup replaces all counts by the sums of the counts before them.
@compute @workgroup_size(kThreads)
fn sum_blocks(@builtin(local_invocation_index) thread: u32) {
  let num_blocks = (sizes.num_keys + kThreads - 1u) / kThreads;
  let share = (num_blocks + kThreads - 1u) / kThreads;
  let first = min(thread * share, num_blocks);
  let end = min(first + share, num_blocks);
  var sum = 0u;
  for (var k = first; k < end; k++) {
    sum += blocks[k];
  }
  var before = sum_before(thread, sum);
  for (var k = first; k < end; k++) {
    let count = blocks[k];
    blocks[k] = before;
    before += count;
  }
  if (thread == kThreads - 1u) {
    pair_sizes.num_keys = min(before, arrayLength(&tiles));
    pair_sizes.num_items = before;
  }
}

// Each thread writes the pairs of one gaussian. Their number was decided by
// project.wgsl, whose rounding may differ; so superfluous places get a tile behind the
// last one.
@compute @workgroup_size(kThreads)
fn write_pairs(
  @builtin(workgroup_id) group: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  let rank = group.x * kThreads + thread;
  let count = num_tiles_at(rank);
  var place = blocks[group.x] + sum_before(thread, count);
  if (count == 0u) {
    return;
  }
  let end = min(place + count, arrayLength(&tiles));
  let gaussian = order[rank];
  let record = records[gaussian];
  let l = vec3f(record.l11, record.l12, record.l22);
  let reach = max(record.log2_opacity - kLog2MinAlpha, 0.0);
  let num_tiles = num_tiles_of(camera.size);
  let rows = tile_rows_of(record.center, l, reach, num_tiles.y);
  for (var row = rows.x; row < rows.y; row++) {
    let columns = tile_columns_of(record.center, l, reach, row, num_tiles.x);
    for (var column = columns.x; column < columns.y && place < end; column++) {
      tiles[place] = row * num_tiles.x + column;
      gaussians[place] = gaussian;
      place++;
    }
  }
  while (place < end) {
    tiles[place] = num_tiles.x * num_tiles.y;
    gaussians[place] = gaussian;
    place++;
  }
}
