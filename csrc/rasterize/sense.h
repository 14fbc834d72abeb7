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

struct RasterTape;  // rasterize.h

// The channels and the meshes of a frame's pictures, in device memory.
struct FrameSensors {
    Sensor first;   // of the first picture
    Sensor second;  // of the second of two eyes
    // Number of pixels of a picture, if the planes of all pictures follow each other. 0
    // if there are at most two pictures with planes of their own.
    size_t num_pixels = 0;

    // Returns whether the sensor pass has anything to do. It does not set the channel
    // `clipped` (draw/clipped.h).
    bool is_on() const { return first.planes.wants_walk() || first.mesh.is_there(); }
    bool wants_clipped() const { return first.planes.clipped != nullptr; }
    // Returns whether the channels need the normals, and the instances, of records.
    bool needs_normals() const { return first.planes.normal != nullptr; }
    bool needs_instances() const { return first.planes.wants_ids(); }
    V3DG_HD Sensor of(uint32_t picture) const {
        if (num_pixels > 0) return first.from(picture * num_pixels);
        return picture == 0 ? first : second;
    }
};

// Computes the channels of pictures that were blended with a tape, and mixes meshes
// into them. `lists` and `tape` are those of rasterize(). Does not wait.
void sense(const FrameLists& lists, const RasterTape& tape, const SensedRecords& records,
           const FrameSensors& sensors, Stream stream);

}  // namespace cuda

}  // namespace v3dg
