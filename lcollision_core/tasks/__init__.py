"""What people do, once each: a typed request in, a typed result out; every front end runs these."""
