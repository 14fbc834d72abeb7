#pragma once

// The sensor pass of a frame on the CPU.

#include <atomic>
#include <vector>

#include "camera/pixel_slopes.h"
#include "draw/render.h"

namespace v3dg {

// Returns whether the sensor's channels need the gaussian of each record.
bool needs_source_of(const DrawnSensor& sensor);

// Walks the lists of a band that was drawn: the tiles of picture.window. The planes of
// the sensor begin with the first pixel of the band. The workspace has the records and
// the sorted lists and, if needs_source_of(), the sources.
void sense_band(const std::vector<Draw<float>>& draws, const Picture<float>& picture,
                const DrawnSensor& sensor, Workspace<float>& workspace,
                const std::atomic<bool>* stop);

// Marks the pixels of a window whose rays, from the near plane on, meet the body of a
// gaussian that is not drawn because its mean is before that plane: 1, else 0. `draws`
// has all gaussians that may be near, not only those in the frustum.
void mark_clipped(const std::vector<Draw<float>>& draws, const PixelSlopes& slopes,
                  const Window& window, uint8_t* clipped, const std::atomic<bool>* stop);

}  // namespace v3dg
