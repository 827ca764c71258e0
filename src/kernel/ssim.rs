//! Structural similarity of two volumes (3-D, 11^3 Gaussian window, sigma 1.5), streamed.
