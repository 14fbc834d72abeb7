#include "draw/sensing_frame_cuda.h"

#include "rasterize/sense.h"

namespace v3dg {
namespace cuda {

std::unique_ptr<Drawing> SensingFrame::draw(const ModelPicture& in, float min_transmittance,
                                            const Sensor& sensor, cudaStream_t stream) {
    std::unique_ptr<Drawing> drawing = frame_.draw(in.rows, in.view, in.filter_px2, in.antialiased,
                                                   in.image, stream, nullptr, min_transmittance);
    drawing->settle();
    const FrameTape tape = frame_.tape();
    sense({.image = in.image,
           .records = tape.lists.records,
           .tile_first = tape.lists.tile_first,
           .order = tape.raster.order,
           .blended = tape.raster.blended,
           .source = tape.source,
           .rows = in.rows,
           .view = in.view,
           .min_transmittance = min_transmittance,
           .sensor = sensor},
          stream);
    return drawing;
}

}  // namespace cuda
}  // namespace v3dg
