// Sorts keys of 28 bits with values, stably: radix sort with digits of 4 bits. Each
// pass counts the digits of every tile, sums the counts, and moves the keys. No
// workgroup waits for another one, so devices that do not run all workgroups at once
// cannot hang.

struct Pass {
  count: u32,
  shift: u32,
  num_tiles: u32,
}

const kThreads = 256u;
const kKeysOfThread = 8u;
const kTile = kThreads * kKeysOfThread;
const kDigits = 16u;

@group(0) @binding(0) var<uniform> sorting: Pass;
@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
// [digit][tile] number of keys; after sum_counts(), of keys before them
@group(0) @binding(5) var<storage, read_write> counts: array<u32>;

fn digit_of(key: u32) -> u32 {
  return (key >> sorting.shift) % kDigits;
}

var<workgroup> digit_counts: array<atomic<u32>, kDigits>;

@compute @workgroup_size(kThreads)
fn count_digits(
  @builtin(workgroup_id) tile: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  if (thread < kDigits) {
    atomicStore(&digit_counts[thread], 0u);
  }
  workgroupBarrier();
  for (var k = 0u; k < kKeysOfThread; k++) {
    let index = tile.x * kTile + k * kThreads + thread;
    if (index < sorting.count) {
      atomicAdd(&digit_counts[digit_of(keys_in[index])], 1u);
    }
  }
  workgroupBarrier();
  if (thread < kDigits) {
    counts[thread * sorting.num_tiles + tile.x] = atomicLoad(&digit_counts[thread]);
  }
}

var<workgroup> sums: array<u32, kThreads>;

// Returns the sum of the values of the threads before this one, and sets `sums` to the
// sums up to and including each thread. All threads of the workgroup must call it.
fn sum_before(thread: u32, value: u32) -> u32 {
  sums[thread] = value;
  workgroupBarrier();
  for (var step = 1u; step < kThreads; step *= 2u) {
    var added = 0u;
    if (thread >= step) {
      added = sums[thread - step];
    }
    workgroupBarrier();
    sums[thread] += added;
    workgroupBarrier();
  }
  return sums[thread] - value;
}

// One workgroup replaces all counts by the sums of the counts before them.
@compute @workgroup_size(kThreads)
fn sum_counts(@builtin(local_invocation_index) thread: u32) {
  let total = kDigits * sorting.num_tiles;
  let share = (total + kThreads - 1u) / kThreads;
  let first = min(thread * share, total);
  let end = min(first + share, total);
  var sum = 0u;
  for (var k = first; k < end; k++) {
    sum += counts[k];
  }
  var before = sum_before(thread, sum);
  for (var k = first; k < end; k++) {
    let count = counts[k];
    counts[k] = before;
    before += count;
  }
}

// [pair of digits][thread] number of keys of the threads before: two of 16 bits
var<workgroup> ranks: array<array<u32, kThreads>, 8>;

// Replaces the counts of all threads by the sums of the counts of the threads before.
fn sum_ranks(thread: u32) {
  workgroupBarrier();
  for (var step = 1u; step < kThreads; step *= 2u) {
    var added = array<u32, 8>();
    if (thread >= step) {
      for (var k = 0u; k < 8u; k++) {
        added[k] = ranks[k][thread - step];
      }
    }
    workgroupBarrier();
    for (var k = 0u; k < 8u; k++) {
      ranks[k][thread] += added[k];
    }
    workgroupBarrier();
  }
}

// Each thread moves neighbouring keys, so that equal keys keep their order.
@compute @workgroup_size(kThreads)
fn move_keys(
  @builtin(workgroup_id) tile: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  let first = tile.x * kTile + thread * kKeysOfThread;
  var own: array<u32, 8>;
  for (var k = 0u; k < kKeysOfThread; k++) {
    if (first + k < sorting.count) {
      let digit = digit_of(keys_in[first + k]);
      own[digit / 2u] += 1u << (16u * (digit % 2u));
    }
  }
  for (var k = 0u; k < 8u; k++) {
    ranks[k][thread] = own[k];
  }
  sum_ranks(thread);
  var next: array<u32, 8>;
  for (var k = 0u; k < 8u; k++) {
    next[k] = ranks[k][thread] - own[k];
  }
  for (var k = 0u; k < kKeysOfThread; k++) {
    if (first + k < sorting.count) {
      let key = keys_in[first + k];
      let digit = digit_of(key);
      let shift = 16u * (digit % 2u);
      let rank = (next[digit / 2u] >> shift) & 0xffffu;
      next[digit / 2u] += 1u << shift;
      let place = counts[digit * sorting.num_tiles + tile.x] + rank;
      keys_out[place] = key;
      values_out[place] = values_in[first + k];
    }
  }
}
