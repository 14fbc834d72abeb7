#pragma once

// The sensor pass: it processes the lists of tiles again after blending, and computes
// further channels of pixels. If the scene has meshes, it also mixes them into the
// blended picture.

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

struct SensedRecords;  // defined in sense_math.h

// Processes the sorted entries of one tile. `picture` has the blended pixels; if there
// is a mesh, their colour, alpha and depth are changed. The planes of `sensor`, like
// those of `picture`, begin with the first pixel of the picture's window. (left, top)
// is the tile's first pixel.
V3DG_DECLARE_PER_ISA(void sense_tile(const Record<float>* records, const SensedRecords& sensed,
                                     EntryFormat format, const uint64_t* entry, size_t count,
                                     int left, int top, const Picture<float>& picture,
                                     const Sensor& sensor))

namespace cuda {

struct RasterTape;  // defined in rasterize.h

// The channels and the meshes of a frame's pictures, in device memory.
struct FrameSensors {
    Sensor first;   // sensor of the first picture
    Sensor second;  // sensor of the second picture of a stereo pair
    // If all pictures share their planes, one after another: the number of pixels per
    // picture. 0 if there are at most two pictures, each with its own planes.
    size_t num_pixels = 0;

    // Returns whether the sensor pass has anything to do. It does not set the channel
    // `clipped` (draw/clipped.h).
    bool is_on() const { return first.planes.wants_walk() || first.mesh.is_there(); }
    bool wants_clipped() const { return first.planes.clipped != nullptr; }
    // Returns whether the channels need the normals and the instances of records.
    bool needs_normals() const { return first.planes.normal != nullptr; }
    bool needs_instances() const { return first.planes.wants_ids(); }
    V3DG_HD Sensor of(uint32_t picture) const {
        if (num_pixels > 0) return first.from(picture * num_pixels);
        return picture == 0 ? first : second;
    }
};

// Computes the channels of pictures that were blended with a tape, and mixes meshes
// into them. Pass the same `lists` and `tape` as to rasterize(). Does not wait for the
// device.
void sense(const FrameLists& lists, const RasterTape& tape, const SensedRecords& records,
           const FrameSensors& sensors, Stream stream);

}  // namespace cuda

}  // namespace v3dg
