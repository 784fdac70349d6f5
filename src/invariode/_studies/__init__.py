"""Questions about a problem: is this conserved, what is conserved, what does which accuracy cost?"""
