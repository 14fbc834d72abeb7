"""Drawing with WebGPU: the shaders of web pages, run by the package wgpu."""
