//! The library of physics that a simulation can leave out.
