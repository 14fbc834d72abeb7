#pragma once

// The sensor pass: walks the lists of tiles once more, after the colours are blended,
// and computes further channels of pixels. Among meshes, it also mixes the meshes into
// the blended picture.

#include <cstddef>
#include <cstdint>

#include "base/isa.h"
#include "base/stream.h"
#include "frame/entry.h"
#include "frame/image.h"
#include "frame/record.h"
#include "frame/sensor.h"
#include "frame/tile_list.h"
#include "math/gaussian.h"
#include "math/view.h"

namespace v3dg {

struct SensedRecords;  // sense_math.h

// Walks the sorted entries of one tile. `picture` has the blended pixels; with a mesh,
// its colour, alpha and depth are changed. The planes of `sensor` begin with the first
// pixel of the picture's window, as those of the picture do. (left, top) is the tile's
// first pixel.
V3DG_DECLARE_PER_ISA(void sense_tile(const Record<float>* records, const SensedRecords& sensed,
                                     EntryFormat format, const uint64_t* entry, size_t count,
                                     int left, int top, const Picture<float>& picture,
                                     const Sensor& sensor))

namespace cuda {

// A picture of one model that was drawn with a tape, in device memory.
struct SenseInput {
    FrameImage image;  // with planes; its first tile is 0
    RecordPlanes records;
    // [num_tiles + 1] first element of each tile in `order`
    const unsigned long long* tile_first;
    const uint32_t* order;    // records of each tile, front to back
    const uint32_t* blended;  // [num_tiles] number of records in `order`
    const uint32_t* source;   // row of each record's gaussian, for normals
    GaussianRows<const float> rows;
    ModelView<float> view;
    float min_transmittance;
    Sensor sensor;  // not the channel `clipped`
};

// Runs the sensor pass of a picture. All gaussians are of instance 0. Waits, because
// the frame's next picture may be drawn on another stream.
void sense(const SenseInput& in, Stream stream);

}  // namespace cuda

}  // namespace v3dg
