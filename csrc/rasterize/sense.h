#pragma once

// The sensor pass: walks the lists of tiles once more, after the colours are blended,
// and computes further channels of pixels. Among meshes, it also mixes the meshes into
// the blended picture.

#include <cstddef>
#include <cstdint>

#include "base/isa.h"
#include "frame/entry.h"
#include "frame/image.h"
#include "frame/record.h"
#include "frame/sensor.h"

namespace v3dg {

// What the sensor pass reads of records beside what blending reads. An array is null if
// no channel needs it.
struct SensedRecords {
    const float* normal;      // (N, 3) in view space
    const int32_t* instance;  // (N)
    const int32_t* label;     // per instance; null: none has a label
};

// Walks the sorted entries of one tile. `picture` has the blended pixels; with a mesh,
// its colour, alpha and depth are changed. The planes of `sensor` begin with the first
// pixel of the picture's window, as those of the picture do. (left, top) is the tile's
// first pixel.
V3DG_DECLARE_PER_ISA(void sense_tile(const Record<float>* records, const SensedRecords& sensed,
                                     EntryFormat format, const uint64_t* entry, size_t count,
                                     int left, int top, const Picture<float>& picture,
                                     const Sensor& sensor))

}  // namespace v3dg
