// Sorts keys with values by 8 bits, stably. A pass counts the digits of every tile of
// keys, sums the counts of each digit, and moves the keys. No workgroup waits for
// another one, so devices that do not run all workgroups at once cannot hang.

struct Pass {
  shift: u32,
  num_tiles: u32,
  // Keys are replaced by this number of bits of their distance from the lowest key; 0
  // keeps keys as they are.
  bits: u32,
  is_first: u32,  // whether values are the places of keys
}

const kThreads = 128u;
const kKeysOfThread = 8u;
const kTile = kThreads * kKeysOfThread;
const kDigits = 256u;

@group(0) @binding(0) var<uniform> sorting: Pass;
@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
// [digit][tile] number of keys; after sum_counts(), of keys in the tiles before
@group(0) @binding(5) var<storage, read_write> counts: array<u32>;
@group(0) @binding(6) var<storage, read_write> totals: array<u32>;  // number of keys by digit
@group(0) @binding(7) var<storage, read> sizes: Sizes;

fn digit_of(key: u32) -> u32 {
  var place = key;
  if (sorting.bits > 0u) {
    let num_bits = 32u - countLeadingZeros(sizes.highest_key - sizes.lowest_key);
    let dropped = max(num_bits, sorting.bits) - sorting.bits;
    let last = (1u << sorting.bits) - 1u;
    place = min((key - sizes.lowest_key) >> dropped, last - 1u);
    if (key == kNotDrawn) {
      place = last;
    }
  }
  return (place >> sorting.shift) % kDigits;
}

var<workgroup> histogram: array<atomic<u32>, kDigits>;

@compute @workgroup_size(kThreads)
fn count_digits(
  @builtin(workgroup_id) tile: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  for (var digit = thread; digit < kDigits; digit += kThreads) {
    atomicStore(&histogram[digit], 0u);
  }
  workgroupBarrier();
  for (var k = 0u; k < kKeysOfThread; k++) {
    let index = tile.x * kTile + k * kThreads + thread;
    if (index < sizes.num_keys) {
      atomicAdd(&histogram[digit_of(keys_in[index])], 1u);
    }
  }
  workgroupBarrier();
  for (var digit = thread; digit < kDigits; digit += kThreads) {
    counts[digit * sorting.num_tiles + tile.x] = atomicLoad(&histogram[digit]);
  }
}

// Two sides, of which each step reads one and writes the other.
var<workgroup> sums: array<u32, 2u * kThreads>;
const kSumSteps = 7u;
const kLastSum = (kSumSteps % 2u) * kThreads + kThreads - 1u;

// Returns the sum of the values of the threads before this one; sums[kLastSum] is the
// sum of all values. All threads of the workgroup must call it, and pass a barrier
// before they call it again.
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

// One workgroup for each digit.
@compute @workgroup_size(kThreads)
fn sum_counts(
  @builtin(workgroup_id) digit: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  let share = (sorting.num_tiles + kThreads - 1u) / kThreads;
  let row = digit.x * sorting.num_tiles;
  let first = row + min(thread * share, sorting.num_tiles);
  let end = min(first + share, row + sorting.num_tiles);
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
  if (thread == kThreads - 1u) {
    totals[digit.x] = before;
  }
}

const kPlaceBits = 16u;
const kPlaceMask = 0xffffu;
const kHalfDigits = 16u;
const kWordsOfRanks = kHalfDigits / 2u;

// Arrays of a workgroup have an unused word after 32 words, so that threads which read
// words at a distance of 8 use different banks of the memory.
fn padded(index: u32) -> u32 {
  return index + index / 32u;
}

// The keys of the tile: their places in the tile and, above, their digits. There are
// two sides, of which each sort reads one and writes the other.
const kSide = kTile + kTile / 32u;
var<workgroup> order: array<u32, 2u * kSide>;
// [half digit modulo 8][thread] number of keys before: two counts of 16 bits, of which
// the upper one is of half digits from 8 on.
const kRanks = kWordsOfRanks * kThreads;
var<workgroup> ranks: array<u32, kRanks + kRanks / 32u>;

fn rank_of(half_digit: u32, thread: u32) -> u32 {
  return padded((half_digit % kWordsOfRanks) * kThreads + thread);
}

fn shift_of(half_digit: u32) -> u32 {
  return 16u * (half_digit / kWordsOfRanks);
}

// Sorts the keys by 4 bits, stably, from a side of `order` to the other one. Each
// thread moves neighbouring keys.
fn sort_by_half_digit(thread: u32, shift: u32, source: u32) {
  let first = thread * kKeysOfThread;
  for (var k = 0u; k < kWordsOfRanks; k++) {
    ranks[padded(k * kThreads + thread)] = 0u;
  }
  for (var k = 0u; k < kKeysOfThread; k++) {
    let digit = (order[source + padded(first + k)] >> shift) % kHalfDigits;
    ranks[rank_of(digit, thread)] += 1u << shift_of(digit);
  }
  workgroupBarrier();
  var sum = 0u;
  for (var k = 0u; k < kWordsOfRanks; k++) {
    sum += ranks[padded(thread * kWordsOfRanks + k)];
  }
  var before = sum_before(thread, sum);
  before += sums[kLastSum] << 16u;
  for (var k = 0u; k < kWordsOfRanks; k++) {
    let rank = padded(thread * kWordsOfRanks + k);
    let count = ranks[rank];
    ranks[rank] = before;
    before += count;
  }
  workgroupBarrier();
  for (var k = 0u; k < kKeysOfThread; k++) {
    let key = order[source + padded(first + k)];
    let digit = (key >> shift) % kHalfDigits;
    let rank = rank_of(digit, thread);
    let place = (ranks[rank] >> shift_of(digit)) & kPlaceMask;
    ranks[rank] += 1u << shift_of(digit);
    order[kSide - source + padded(place)] = key;
  }
  workgroupBarrier();
}

// [digit] place of its first key among all keys, minus its first place in the tile
var<workgroup> starts: array<u32, kDigits>;

// Sets `starts` to the first place of each digit in the tile.
fn find_starts(thread: u32) {
  for (var k = 0u; k < kKeysOfThread; k++) {
    let place = k * kThreads + thread;
    let digit = order[padded(place)] >> kPlaceBits;
    if (place == 0u || order[padded(max(place, 1u) - 1u)] >> kPlaceBits != digit) {
      starts[digit] = place;
    }
  }
}

// The digits are sorted in the workgroup first, so that neighbouring threads write
// neighbouring keys.
@compute @workgroup_size(kThreads)
fn move_keys(
  @builtin(workgroup_id) tile: vec3u,
  @builtin(local_invocation_index) thread: u32,
) {
  let begin = tile.x * kTile;
  if (begin >= sizes.num_keys) {
    return;
  }
  let num_keys = min(sizes.num_keys - begin, kTile);
  for (var k = 0u; k < kKeysOfThread; k++) {
    let place = k * kThreads + thread;
    var digit = kDigits - 1u;
    if (place < num_keys) {
      digit = digit_of(keys_in[begin + place]);
    }
    order[padded(place)] = place | (digit << kPlaceBits);
  }
  workgroupBarrier();
  sort_by_half_digit(thread, kPlaceBits, 0u);
  sort_by_half_digit(thread, kPlaceBits + 4u, kSide);
  find_starts(thread);
  let digit = 2u * thread;
  let total = totals[digit];
  let base = sum_before(thread, total + totals[digit + 1u]);
  let count = digit * sorting.num_tiles + tile.x;
  starts[digit] = base + counts[count] - starts[digit];
  starts[digit + 1u] = base + total + counts[count + sorting.num_tiles] - starts[digit + 1u];
  workgroupBarrier();
  for (var k = 0u; k < kKeysOfThread; k++) {
    let place = k * kThreads + thread;
    if (place < num_keys) {
      let key = order[padded(place)];
      let source = begin + (key & kPlaceMask);
      let target_place = starts[key >> kPlaceBits] + place;
      keys_out[target_place] = keys_in[source];
      var value = source;
      if (sorting.is_first == 0u) {
        value = values_in[source];
      }
      values_out[target_place] = value;
    }
  }
}
